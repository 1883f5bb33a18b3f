"""Runs of the live-path benchmark: figures against camera and recording, and early ends."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Self

import pytest
from PyQt6.QtCore import QTimer
from PyQt6.QtWidgets import QApplication
from support.gui_bench import BENCH, FakeCamera, opener
from support.posix import press_ctrl_c

from app.acquisition.address import Address
from app.acquisition.remote.own_connection import OwnConnection
from app.acquisition.remote.own_instrument import OwnInstrument
from app.acquisition.start_up import HeadlessRun
from app.acquisition.worker import Acquisition
from app.bench.config import Bench, load_bench
from app.commands.benchmark import benchmark_acquisition, print_figures
from app.errors import InputError, Interrupted, RunError
from app.evaluation.live_path import LivePlan, measure_span
from app.evaluation.processor_time import memory_mb
from drivers.interface import Disconnected

pytestmark = pytest.mark.usefixtures("restored_theme")


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


def started(bench: Bench) -> HeadlessRun:
    run = HeadlessRun(InThisProcess("test").connect(bench), no_report)
    run.acquisition.start()
    run.send()
    return run


@pytest.mark.slow
@pytest.mark.usefixtures("runtime_folder")
def test_run_measures_an_instrument_in_a_process_of_its_own(
    small_toml: Path,
    qapp: QApplication,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert qapp is QApplication.instance()
    monkeypatch.setenv("QT_QPA_PLATFORM", "offscreen")
    connections: list[OwnConnection] = []
    reports: list[tuple[str, float]] = []
    connect = OwnInstrument.connect

    def noted(own: OwnInstrument, bench: Bench) -> OwnConnection:
        connections.append(connect(own, bench))
        return connections[-1]

    monkeypatch.setattr(OwnInstrument, "connect", noted)
    plan = LivePlan(bench=load_bench(small_toml), seconds=2.0, record_in=tmp_path, warm_up_s=0.5)
    figures = benchmark_acquisition(plan, lambda text, fraction: reports.append((text, fraction)))
    assert [each.process.poll() for each in connections] == [0, 0]
    assert not list(tmp_path.iterdir())
    assert figures.recording is not None
    assert figures.recording.stage == "finished"
    window, bare = figures.window, figures.bare
    assert 0 < window.redrawn_hz < 27
    assert figures.rate_ratio == window.rate_hz / bare.rate_hz
    fractions = [fraction for _, fraction in reports]
    assert fractions == sorted(fractions)
    assert reports[-1][0].startswith("no window: ")
    live = json.loads(json.dumps(figures.tree(), allow_nan=False))["live"]
    assert live["window"]["times"]["to_result"]["p99_s"] > 0
    assert live["without_window"]["times"]["draw"]["p99_s"] is None
    print_figures(figures)
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines[3:])) <= 80
    words = [line.split()[-1] for line in lines if line.rstrip().endswith(("met", "missed"))]
    assert words.count("missed") == sum(not each["is_met"] for each in live["limits"].values())
    assert len(words) == len(live["limits"])
    in_hand = 1  # read before the span, measured in it
    assert 0 < window.frames.reconstructed <= window.frames.acquired + in_hand
    assert window.frames.acquired <= figures.recording.frames
    assert window.times["draw"].count > 0
    assert window.times["to_screen"].p50_s > window.times["draw"].p50_s
    assert (bare.times["draw"].count, bare.times["record"].count) == (0, 0)
    assert bare.times["to_result"].count > 0
    if memory_mb():
        assert window.memory_mb[1].keys() >= {"window", "instrument"}
        assert window.total_mb[1] > max(window.memory_mb[1].values()) + 50
        assert 0 < window.processor_s["instrument"] <= window.seconds * (os.cpu_count() or 1)
        assert window.processor_s["window"] > 0
        assert figures.processor_s is not None
        assert figures.processor_s > sum(window.processor_s.values())


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
    acted = when_recorded(tmp_path, press_ctrl_c)
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
    watched = started(BENCH)
    with pytest.raises(RunError, match="the camera is gone"):  # noqa: PT012 - it goes on until then
        for _ in measure_span(watched, 0.0, 0.1, 60.0):
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
    watched = started(BENCH)
    with pytest.raises(InputError, match="holds a recording already"):  # noqa: PT012 - it goes on until then
        for _ in measure_span(watched, 0.0, 60.0, 60.0, tmp_path):
            time.sleep(0.02)
    watched.acquisition.close()
    assert camera.is_closed
