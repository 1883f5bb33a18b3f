"""Runs of the live-path benchmark: figures against camera and recording, and early ends."""

from __future__ import annotations

import json
import os
import shutil
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Self

import pytest
from PyQt6.QtCore import QTimer
from PyQt6.QtWidgets import QApplication
from support.gui_bench import BENCH, FakeCamera, opener
from support.simulated_scene import lose_frames

from app.acquisition.address import Address
from app.acquisition.devices import open_devices
from app.acquisition.frame_path import FramePath
from app.acquisition.remote.own_instrument import OwnConnection, OwnInstrument
from app.acquisition.worker import Acquisition
from app.bench.config import Bench, load_bench
from app.commands.benchmark import benchmark_acquisition, print_figures
from app.errors import InputError, Interrupted, RunError
from app.evaluation.benchmark.live_path import LiveFigures, LivePlan, MeasuredRun, resident_mb
from app.gui.panels.coefficients import CoefficientsPanel
from app.measurement.measurement import Measurement
from app.recording.reader import Recording
from app.results.coefficients import ModeCoefficients
from drivers.interface import Devices, Disconnected, Frame
from simulated_devices.camera import SimulatedCamera

LOST = 24


def no_report(_text: str, _fraction: float) -> None:
    pass


class InThisProcess:
    """Stands for `OwnInstrument`, so that a test sees the devices."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def connect(self, bench: Bench) -> Acquisition:
        made = Acquisition(bench)
        made.address = Address(self._name, os.getpid(), "", "")  # type: ignore[attr-defined] # as a connection's
        return made


def course_of(bench: Bench, warm_up_s: float, record_into: Path | None = None) -> MeasuredRun:
    own = InThisProcess("test").connect(bench)
    return MeasuredRun(own, no_report, warm_up_s=warm_up_s, seconds=60, record_into=record_into)  # type: ignore[arg-type] # as above


@dataclass
class Seen:
    """The frames of the camera, and facts of the recording before its removal."""

    figures: LiveFigures
    frames: list[Frame]
    lines: int
    lost: int
    is_complete: bool
    nbytes: int
    late_s: float  # from the arrival of a frame until it was counted, at most
    shown_bars: int  # times that bars of coefficients were drawn
    reports: list[tuple[str, float]]

    def between(self, first_s: float, last_s: float) -> list[Frame]:
        return [frame for frame in self.frames if first_s <= frame.host_time_s <= last_s]


@pytest.fixture(scope="module")
def seen(small_toml: Path, qapp: QApplication, tmp_path_factory: pytest.TempPathFactory) -> Seen:
    """One run on the simulated bench with an offscreen window, and with lost frames."""
    assert qapp is QApplication.instance()
    folder, kept = tmp_path_factory.mktemp("disk"), dict[str, Any]()
    frames, reports, cameras = list[Frame](), list[tuple[str, float]](), list[SimulatedCamera]()

    def open_watched(bench: Bench, progress: Callable[[float], None]) -> Devices:
        devices = open_devices(bench, progress)
        camera = devices.camera
        assert isinstance(camera, SimulatedCamera)
        cameras.append(camera)
        read, is_lost = camera.read, bool(frames)

        def watch(timeout_s: float) -> Frame:
            nonlocal is_lost
            frame = read(timeout_s)
            frames.append(frame)
            if not is_lost and reports and reports[-1][0] == "unseen window: measuring":
                is_lost = True
                lose_frames(camera, LOST)
            return frame

        camera.read = watch  # type: ignore[method-assign] # every frame goes through here
        return devices

    def inspect_and_remove(path: Path) -> None:
        recording = Recording(path / "recording")
        kept.update(
            lines=len(recording),
            lost=sum(recording.line(index).lost for index in range(len(recording))),
            is_complete=recording.is_complete,
            nbytes=sum(512 * each.lstat().st_blocks for each in path.rglob("*")),
        )
        remove(path)

    remove, publish = shutil.rmtree, FramePath._publish

    def publish_and_time(path: FramePath, measurement: Measurement) -> None:
        publish(path, measurement)
        late_s = time.perf_counter() - measurement.frame.host_time_s
        kept["late_s"] = max(kept.get("late_s", 0.0), late_s)

    def show_bars(panel: CoefficientsPanel, coefficients: ModeCoefficients | None) -> None:
        kept["shown_bars"] = kept.get("shown_bars", 0) + (panel.isVisible() and coefficients is not None)

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("QT_QPA_PLATFORM", "offscreen")
        patch.setattr(CoefficientsPanel, "show_result", show_bars)
        patch.setattr("app.acquisition.devices.open_devices", open_watched)
        patch.setattr(shutil, "rmtree", inspect_and_remove)
        patch.setattr(FramePath, "_publish", publish_and_time)
        patch.setattr("app.acquisition.remote.own_instrument.OwnInstrument", InThisProcess)
        figures = benchmark_acquisition(
            LivePlan(bench=load_bench(small_toml), seconds=2.0, record_in=folder, warm_up_s=0.5, with_panels=True),
            lambda text, fraction: reports.append((text, fraction)),
        )
    assert not list(folder.iterdir())
    assert [camera.state for camera in cameras] == ["closed", "closed"]
    return Seen(figures, frames, reports=reports, **kept)


@pytest.mark.slow
@pytest.mark.long
def test_counted_frames_match_the_camera(seen: Seen) -> None:
    for span in (seen.figures.window, seen.figures.bare):
        began_s, ended_s = span.began_s, span.began_s + span.seconds
        counts, late_s = span.frames, seen.late_s
        during, around = seen.between(began_s, ended_s - late_s), seen.between(began_s - late_s, ended_s)
        assert len(during) <= counts.acquired <= len(around)
        assert lost_of(during) <= counts.lost <= lost_of(around)
        at_an_edge = len(around) - len(during)
        assert counts.reconstructed - at_an_edge <= span.times["to_result"].count <= len(around)
        assert span.rate_hz == counts.reconstructed / span.seconds
    window = seen.figures.window
    assert window.seconds >= 2.0
    assert window.first_wavefront_s > 0
    assert seen.figures.checks()["lost"].is_met == (window.frames.lost == 0)


def lost_of(frames: list[Frame]) -> int:
    return sum(after.index - before.index - 1 for before, after in pairwise(frames))


@pytest.mark.slow
def test_recording_holds_warm_up_and_span_within_the_estimated_size(seen: Seen) -> None:
    figures = seen.figures
    assert figures.recording is not None
    assert (figures.recording.frames, figures.recording.stage) == (seen.lines, "finished")
    assert seen.is_complete
    assert seen.lines >= figures.window.frames.acquired
    assert seen.lost >= figures.window.frames.lost
    assert seen.nbytes < figures.plan.recording_bytes * (50 + seen.lines) / (50 + 2.5 / 0.02)
    assert figures.checks()["recording_problems"].is_met
    assert figures.window.times["record"].count > 0


@pytest.mark.slow
def test_bare_run_draws_and_records_nothing(seen: Seen) -> None:
    window, bare = seen.figures.window, seen.figures.bare
    assert 0 < window.redrawn_hz < 27
    assert window.times["to_screen"].count > 0
    times = bare.times
    assert (bare.redrawn_hz, times["draw"].count, times["record"].count) == (0, 0, 0)
    assert seen.figures.rate_ratio == window.rate_hz / bare.rate_hz


@pytest.mark.slow
def test_panels_asked_for_are_open(seen: Seen) -> None:
    assert seen.shown_bars > 1


@pytest.mark.slow
def test_progress_increases(seen: Seen) -> None:
    texts = [text for text, _ in seen.reports]
    stages = ["unseen window: warming up", "unseen window: measuring", "unseen window: removing the recording"]
    stages_seen = [text for text in dict.fromkeys(texts) if text in stages]
    assert stages_seen == [text for text in stages if text in stages_seen]  # no poll may come during a stage
    assert stages_seen[-1] == stages[-1]
    assert texts[-1].startswith("no window: ")
    fractions = [fraction for _, fraction in seen.reports]
    assert fractions == sorted(fractions)
    assert 0.68 < fractions[-1] <= 1  # the first run took 0.68 of the planned time


@pytest.mark.slow
def test_figures_are_written_and_printed(seen: Seen, capsys: pytest.CaptureFixture[str]) -> None:
    written = json.loads(json.dumps(seen.figures.tree(), allow_nan=False))
    assert set(written) == {"live", "machine", "versions"}
    live = written["live"]
    assert live["window"]["frames"]["lost"] == seen.figures.window.frames.lost
    assert live["window"]["timings"]["to_result"]["p99_s"] > 0
    assert live["without_window"]["timings"]["draw"]["p99_s"] is None
    assert live["limits"]["lost"] == {
        "value": live["window"]["frames"]["lost"],
        "limit": 0,
        "is_met": not live["window"]["frames"]["lost"],
    }
    assert live["recording"] == {"frames": seen.lines, "problem": ""}
    assert live["window_is_seen"] is False
    print_figures(seen.figures)
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines[3:])) <= 80
    assert "\N{HORIZONTAL ELLIPSIS}" not in "".join(lines), lines
    assert "the window was drawn offscreen" in lines[2]
    words = [line.split()[-1] for line in lines if line.rstrip().endswith(("met", "missed"))]
    assert words.count("missed") == sum(not each["is_met"] for each in live["limits"].values())
    assert len(words) == len(live["limits"])


@pytest.mark.slow
@pytest.mark.usefixtures("runtime_folder")
def test_run_measures_an_instrument_in_a_process_of_its_own(
    small_toml: Path, qapp: QApplication, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    assert qapp is QApplication.instance()
    monkeypatch.setenv("QT_QPA_PLATFORM", "offscreen")
    connections: list[OwnConnection] = []
    connect = OwnInstrument.connect

    def noted(own: OwnInstrument, bench: Bench) -> OwnConnection:
        connections.append(connect(own, bench))
        return connections[-1]

    monkeypatch.setattr(OwnInstrument, "connect", noted)
    plan = LivePlan(bench=load_bench(small_toml), seconds=2.0, record_in=tmp_path, warm_up_s=0.5)
    figures = benchmark_acquisition(plan, no_report)
    assert [each.process.poll() for each in connections] == [0, 0]
    assert not list(tmp_path.iterdir())
    assert figures.recording is not None
    assert figures.recording.stage == "finished"
    window, bare = figures.window, figures.bare
    in_hand = 1  # read before the span, measured in it
    assert 0 < window.frames.reconstructed <= window.frames.acquired + in_hand
    assert window.frames.acquired <= figures.recording.frames
    assert window.times["draw"].count > 0
    assert (bare.times["draw"].count, bare.times["record"].count) == (0, 0)
    assert bare.times["to_result"].count > 0
    own_mb = resident_mb(os.getpid())
    if own_mb is not None:
        assert window.memory_mb[1] is not None
        assert window.memory_mb[1] > own_mb + 50  # the instrument's, too


@pytest.fixture
def camera(monkeypatch: pytest.MonkeyPatch, qapp: QApplication) -> FakeCamera:
    made = FakeCamera()
    monkeypatch.setattr("app.acquisition.devices.open_devices", opener(made))
    monkeypatch.setattr("app.acquisition.remote.own_instrument.OwnInstrument", InThisProcess)
    monkeypatch.setenv("QT_QPA_PLATFORM", "offscreen")
    assert qapp is QApplication.instance()
    return made


def when_recorded(folder: Path, act: Callable[[], None]) -> QTimer:
    """Act as soon as a frame has been recorded."""

    def look() -> None:
        if any(each.stat().st_size for each in folder.glob("*/recording/frames.jsonl")):
            timer.stop()
            act()

    timer = QTimer()
    timer.timeout.connect(look)
    timer.start(20)
    return timer


@pytest.mark.slow
@pytest.mark.long
def test_interrupt_turns_light_off_and_removes_recording(camera: FakeCamera, tmp_path: Path) -> None:
    acted = when_recorded(tmp_path, lambda: os.kill(os.getpid(), signal.SIGINT))
    with pytest.raises(Interrupted):
        benchmark_acquisition(LivePlan(bench=BENCH, seconds=60, record_in=tmp_path), no_report)
    assert not acted.isActive()
    assert camera.is_closed
    assert not camera.light.shines
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_camera_failure_ends_the_run_with_its_message(camera: FakeCamera, tmp_path: Path) -> None:
    acted = when_recorded(tmp_path, lambda: setattr(camera, "fault", Disconnected("the camera is gone")))
    with pytest.raises(RunError, match="the camera is gone"):
        benchmark_acquisition(LivePlan(bench=BENCH, seconds=60, record_in=tmp_path), no_report)
    assert not acted.isActive()
    assert not list(tmp_path.iterdir())


def test_camera_failure_ends_the_bare_run(camera: FakeCamera) -> None:
    watched = course_of(BENCH, warm_up_s=0.1)
    with pytest.raises(RunError, match="before all was measured"):
        _ = watched.span
    watched.acquisition.start()
    watched.send()
    with pytest.raises(RunError, match="the camera is gone"):  # noqa: PT012 - it goes on until then
        for _ in watched.steps():
            if watched.acquisition.counts.reconstructed:
                camera.fault = Disconnected("the camera is gone")
            time.sleep(0.02)
    watched.acquisition.close()


@pytest.mark.slow
def test_saturated_frames_end_the_run_soon(
    small_toml: Path, qapp: QApplication, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert qapp is QApplication.instance()
    monkeypatch.setenv("QT_QPA_PLATFORM", "offscreen")
    bench = load_bench(small_toml, ("camera.em_gain=1000",))
    with pytest.raises(RunError, match=r"no wavefront in the first \d+ frames: .*saturated.*shorten the exposure"):
        benchmark_acquisition(LivePlan(bench=bench, seconds=60, record_in=None), no_report)


def test_folder_with_a_recording_is_rejected(camera: FakeCamera, tmp_path: Path) -> None:
    (tmp_path / "run.json").write_text("{}")
    watched = course_of(BENCH, warm_up_s=60, record_into=tmp_path)
    watched.acquisition.start()
    watched.send()
    with pytest.raises(InputError, match="holds a recording already"):  # noqa: PT012 - it goes on until then
        for _ in watched.steps():
            time.sleep(0.02)
    watched.acquisition.close()
    assert camera.is_closed
