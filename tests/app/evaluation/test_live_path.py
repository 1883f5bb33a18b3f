"""The live-path benchmark: figures against camera and recording, limits, plan, and early ends."""

from __future__ import annotations

import json
import math
import os
import shutil
import signal
import sys
import time
from collections.abc import Callable, Iterator
from copy import copy
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Self

import numpy as np
import pytest
from PyQt6.QtCore import QTimer
from PyQt6.QtWidgets import QApplication
from support.gui_bench import BENCH, FakeCamera, make_measurement, opener
from support.leftovers import left_widgets
from support.simulated_faults import lose_frames

import app.commands.benchmark
from app import cli
from app.acquisition.devices import open_devices
from app.acquisition.frame_path import FramePath
from app.acquisition.place import Place
from app.acquisition.remote.own_instrument import OwnConnection, OwnInstrument
from app.acquisition.start_up import FirstWavefront
from app.acquisition.worker import Acquisition
from app.bench.config import Bench, load_bench
from app.bench.device_kinds import RecordingSettings
from app.commands.benchmark import benchmark_acquisition, print_figures
from app.errors import InputError, Interrupted, RunError, ended_by
from app.evaluation.benchmark.live_path import Course, LiveFigures, LivePlan, Span, recording_folder, resident_mb, share
from app.gui.panels.coefficients import CoefficientsPanel
from app.measurement.measurement import SKIPPED, FrameTotals, Measurement
from app.recording.reader import Recording
from app.recording.recorder import RecordingState
from app.results.coefficients import ModeCoefficients
from app.timing import TimedStage, Timings
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
        made.place = Place(self._name, os.getpid(), "", "")  # type: ignore[attr-defined] # as a connection's
        return made


def course_of(bench: Bench, warm_up_s: float, record_into: Path | None = None) -> Course:
    own = InThisProcess("test").connect(bench)
    return Course(own, no_report, warm_up_s, seconds=60, record_into=record_into)  # type: ignore[arg-type] # as above


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


@pytest.fixture(autouse=True)
def no_window_stays() -> Iterator[None]:
    """Every window is freed after its run, although nobody deletes it."""
    yield
    assert not left_widgets()


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


def test_bare_run_draws_and_records_nothing(seen: Seen) -> None:
    window, bare = seen.figures.window, seen.figures.bare
    assert 0 < window.redrawn_hz < 27
    assert window.times["to_screen"].count > 0
    times = bare.times
    assert (bare.redrawn_hz, times["draw"].count, times["record"].count) == (0, 0, 0)
    assert seen.figures.rate_ratio == window.rate_hz / bare.rate_hz


def test_panels_asked_for_are_open(seen: Seen) -> None:
    assert seen.shown_bars > 1


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


def test_share_counts_lost_frames() -> None:
    assert share(FrameTotals(acquired=3, reconstructed=1, lost=5)) == 1 / 8
    assert math.isnan(share(FrameTotals()))


def test_first_wavefront_is_hopeless_after_twenty_failed_frames() -> None:
    made = make_measurement(np.zeros((300, 430), np.uint16), np.zeros((3, 3, 9, 13)))
    first = FirstWavefront(100.0)
    for _ in range(25):
        first.take(replace(made, wavefront=None, problem=SKIPPED))
    for _ in range(19):
        first.take(replace(made, wavefront=None, problem="too dark"))
        first.check()
    hopeful = copy(first)
    first.take(replace(made, wavefront=None, problem="too dark"))
    with pytest.raises(RunError, match="no wavefront in the first 20 frames: too dark"):
        first.check()
    hopeful.take(made)
    hopeful.take(replace(made, wavefront=None, problem="too dark"))
    hopeful.check()
    assert hopeful.came_s is not None
    with pytest.raises(RunError, match="no wavefront within 0 s: no frame came"):
        FirstWavefront(0.0).check()


def span_of(
    *, redraws: int = 200, draw_s: float = 0.008, late_s: float = 0.02, rate_hz: float = 70.0, **changes: Any
) -> Span:
    """Return ten good seconds, with changes."""
    timings = Timings()
    for count, stage, seconds in ((redraws, "draw", draw_s), (1000, "to_result", late_s), (1000, "record", 0.01)):
        for _ in range(count):
            timings.note(stage, seconds)  # type: ignore[arg-type] # each is a stage
    frames = FrameTotals(acquired=700, reconstructed=round(10 * rate_hz))
    how = {"first_wavefront_s": 14.0, "began_s": 0.0, "seconds": 10.0, "frames": frames, "memory_mb": (800.0, 808.0)}
    return Span(**{"times": timings.summary(), **how, **changes})


def figures_of(window: Span, bare: Span | None = None, problem: str = "", *, with_panels: bool = False) -> LiveFigures:
    state = RecordingState(Path("r"), "ended early" if problem else "finished", 700, 0, 10.0, 60.0, problem)
    planned = LivePlan(bench=BENCH, seconds=10, record_in=Path(), with_panels=with_panels)
    return LiveFigures(plan=planned, is_seen=True, window=window, recording=state, bare=bare or span_of())


def test_good_run_misses_no_limit() -> None:
    figures = figures_of(span_of())
    assert figures.missed() == []
    assert len(figures.checks()) == 10
    assert figures.memory_growth == pytest.approx(0.01)


@pytest.mark.parametrize(
    ("name", "window"),
    [
        ("share", span_of(frames=FrameTotals(acquired=700, reconstructed=699))),
        ("lost", span_of(frames=FrameTotals(acquired=7000, reconstructed=7000, lost=1))),
        ("to_result_p99_s", span_of(late_s=0.03)),
        ("redrawn_hz", span_of(redraws=199)),
        ("draw_p50_s", span_of(draw_s=0.0081)),
        ("rate_ratio", span_of(frames=FrameTotals(acquired=660, reconstructed=660))),
        ("first_wavefront_s", span_of(first_wavefront_s=15.0)),
        ("memory_growth", span_of(memory_mb=(800.0, 816.0))),
    ],
)
def test_each_limit_is_missed_alone(name: str, window: Span) -> None:
    assert [line.split()[0] for line in figures_of(window).missed()] == [name]


def test_redraw_with_panels_has_no_limit_of_its_own() -> None:
    assert figures_of(span_of(draw_s=0.03), with_panels=True).missed() == []


@pytest.mark.parametrize(("stage", "name"), [("record", "record_p99_s"), ("to_result", "to_result_p99_s")])
def test_two_percent_late_frames_miss_the_limit(stage: TimedStage, name: str) -> None:
    timings = Timings()
    for number in range(1000):
        timings.note(stage, 0.035 if number % 50 == 0 else 0.01)
    good = span_of()
    window = replace(good, times={**good.times, stage: timings.summary()[stage]})
    assert [line.split()[0] for line in figures_of(window).missed()] == [name]


def test_early_end_of_recording_is_reported(capsys: pytest.CaptureFixture[str]) -> None:
    figures = figures_of(span_of(), problem="the disk is full")
    assert [line.split()[0] for line in figures.missed()] == ["recording_problems"]
    print_figures(figures)
    assert "The recording ended early: the disk is full" in capsys.readouterr().out


def test_empty_run_misses_limits_and_is_valid_json() -> None:
    empty = span_of(frames=FrameTotals(), times=Timings().summary(), memory_mb=(None, None))
    figures = replace(figures_of(empty, empty), recording=None)
    names = {line.split()[0] for line in figures.missed()}
    assert names == {"share", "to_result_p99_s", "redrawn_hz", "draw_p50_s", "rate_ratio"}
    assert json.loads(json.dumps(figures.tree(), allow_nan=False))["live"]["memory"]["growth"] is None
    print_figures(figures)


@pytest.mark.skipif(sys.platform != "linux", reason="other systems do not report the memory")
def test_resident_memory_matches_the_system() -> None:
    before_mb = resident_mb(os.getpid())
    held = np.ones(64 << 17)  # 64 MB
    after_mb = resident_mb(os.getpid())
    assert before_mb is not None
    assert after_mb is not None
    assert after_mb - before_mb == pytest.approx(64, abs=8)
    assert held.all()
    (line,) = (line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmRSS:"))
    assert after_mb == pytest.approx(int(line.split()[1]) / 1024, rel=0.05)


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


@pytest.mark.parametrize("seconds", [0.0, -5.0, 0.9, 3601.0, math.nan, math.inf])
def test_impossible_duration_is_rejected(seconds: float) -> None:
    with pytest.raises(InputError, match=r"--live .*: must be 1 \.\.\. 3600 seconds"):
        LivePlan(bench=BENCH, seconds=seconds, record_in=None)


def test_real_bench_is_rejected() -> None:
    with pytest.raises(InputError, match="simulated camera; this bench has recording"):
        LivePlan(bench=replace(BENCH, camera=RecordingSettings(folder="r")), seconds=10, record_in=None)


def test_recording_needs_room_on_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    planned = LivePlan(bench=load_bench("live_demo", ("camera.exposure_s=0.014286",)), seconds=600, record_in=tmp_path)
    assert 1 < planned.recording_bytes / (612 * 70 * 512 * 512 * 2) < 1.3
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=int(planned.recording_bytes) - 1))
    with (
        pytest.raises(InputError, match=r"takes up to [\d.]+ GB, and [\d.]+ GB are free.*--record-in"),
        recording_folder(planned, no_report),
    ):
        pass
    assert not list(tmp_path.iterdir())
    nowhere = replace(planned, record_in=tmp_path / "nowhere")
    with pytest.raises(InputError, match="no such folder"), recording_folder(nowhere, no_report):
        pass
    with recording_folder(replace(planned, record_in=None), no_report) as folder:
        assert folder is None


def test_second_interrupt_still_removes_the_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    planned = LivePlan(bench=BENCH, seconds=1, record_in=tmp_path)
    remove = shutil.rmtree

    def remove_interrupted(path: Path) -> None:
        os.kill(os.getpid(), signal.SIGINT)
        remove(path)

    def interrupt(_number: int, _frame: object) -> None:
        raise Interrupted

    monkeypatch.setattr(shutil, "rmtree", remove_interrupted)
    with ended_by(interrupt), pytest.raises(Interrupted), recording_folder(planned, no_report):
        raise Interrupted
    assert not list(tmp_path.iterdir())


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
    watched.begin()
    with pytest.raises(RunError, match="the camera is gone"):  # noqa: PT012 - it goes on until then
        for _ in watched.steps():
            if watched.acquisition.counts.reconstructed:
                camera.fault = Disconnected("the camera is gone")
            time.sleep(0.02)
    watched.acquisition.close()


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
    watched.begin()
    with pytest.raises(InputError, match="holds a recording already"):  # noqa: PT012 - it goes on until then
        for _ in watched.steps():
            time.sleep(0.02)
    watched.acquisition.close()
    assert camera.is_closed


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--live", "0"], "--live 0: must be 1 ... 3600 seconds"),
        (["--live", "5", "--record-in", "nowhere"], "nowhere: no such folder"),
        (["--no-record"], "--live SECONDS"),
        (["--set", "camera.exposure_s=0.02"], "--live SECONDS"),
    ],
)
def test_command_rejects_impossible_options(
    options: list[str], said: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("QT_QPA_PLATFORM", "offscreen")
    monkeypatch.setattr(sys, "argv", ["svwfs", "benchmark", *options])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == 2
    assert said in capsys.readouterr().err


@pytest.mark.parametrize(("late_s", "status"), [(0.02, 0), (0.04, 1)])
def test_command_measures_70_hz_prints_writes_and_checks(
    late_s: float, status: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    plans: list[LivePlan] = []

    def measured(planned: LivePlan, _report: object) -> LiveFigures:
        plans.append(planned)
        return figures_of(span_of(late_s=late_s))

    monkeypatch.setattr(app.commands.benchmark, "benchmark_acquisition", measured)
    options = ["--live", "60", "--record-in", str(tmp_path), "--json", str(tmp_path / "live.json"), "--check"]
    monkeypatch.setattr(sys, "argv", ["svwfs", "benchmark", *options, "--set", "camera.em_gain=8"])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == status
    (planned,) = plans
    camera = planned.bench.camera_model
    assert 1 / camera.exposure_s == pytest.approx(70, abs=0.1)
    assert (camera.rows, camera.columns) == (512, 512)
    assert (camera.em_gain, planned.bench.reconstruction.refine) == (8, False)
    assert (planned.seconds, planned.record_in) == (60, tmp_path)
    assert json.loads((tmp_path / "live.json").read_text())["live"]["limits"]["share"]["is_met"]
    said = capsys.readouterr()
    assert "frames acquired" in said.out
    assert said.err == ("" if status == 0 else "svwfs: missed: to_result_p99_s is 0.04, asked 99 % < 30 ms\n")
