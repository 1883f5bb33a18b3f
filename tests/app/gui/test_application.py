"""Unattended runs of the window, and signals that close it."""

from __future__ import annotations

import ctypes
import errno
import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest
from PyQt6.QtCore import QTimer
from PyQt6.QtGui import QColor, QImage
from PyQt6.QtWidgets import QApplication, QFileDialog
from support.gui_bench import BENCH, FakeCamera, opener
from support.patience import HANG_S

from app.acquisition.remote.connection import RunningInstrument
from app.acquisition.start_up import HeadlessRun
from app.acquisition.worker import Acquisition
from app.errors import Interrupted, RunError
from app.gui.application import headless_steps, run_window
from app.gui.shell.main_window import MainWindow
from app.gui.widgets.copies import save_numbers
from app.measurement.measurement import Measurement
from app.results.player import InstrumentFactory
from drivers.interface import Disconnected

pytestmark = pytest.mark.usefixtures("restored_theme")


@contextmanager
def when_lit(camera: FakeCamera, act: Callable[[], object]) -> Iterator[None]:
    """Call `act` from the event loop as soon as the light is on."""
    timer = QTimer()

    def poll() -> None:
        if camera.light.shines:
            timer.stop()
            act()

    timer.timeout.connect(poll)
    timer.start(20)
    yield
    timer.stop()


def run_headless(
    camera: FakeCamera, seconds: float, screenshot: Path | None = None, finished: list[Measurement] | None = None
) -> int:
    run = HeadlessRun(Acquisition(BENCH, opener(camera)))

    def note(_: RunningInstrument, measurement: Measurement, __: object) -> None:
        if finished is not None:
            finished.append(measurement)

    access = InstrumentFactory(lambda: run.acquisition, lambda _: run.send())
    return run_window(
        lambda window: window.open(access), steps=lambda window: headless_steps(window, run, seconds, screenshot, note)
    )


def run_attended(camera: FakeCamera) -> int:
    return run_window(lambda window: window.open(InstrumentFactory(lambda: Acquisition(BENCH, opener(camera)))))


def test_taskbar_of_windows_joins_the_window_with_its_shortcut(monkeypatch: pytest.MonkeyPatch) -> None:
    """The process takes the identity before it makes a window."""
    taken: list[str] = []

    def make(**_: object) -> None:
        raise LookupError

    shell = SimpleNamespace(SetCurrentProcessExplicitAppUserModelID=taken.append)
    monkeypatch.setattr("app.gui.shortcut.sys", SimpleNamespace(platform="win32"))
    monkeypatch.setattr(ctypes, "windll", SimpleNamespace(shell32=shell), raising=False)
    monkeypatch.setattr("app.gui.application.MainWindow", make)
    with pytest.raises(LookupError):
        run_attended(FakeCamera())
    assert taken == ["svwfs.window"]


@pytest.mark.slow
@pytest.mark.long
def test_unattended_run_saves_screenshot_and_result(qapp: QApplication, tmp_path: Path) -> None:
    camera = FakeCamera()
    finished: list[Measurement] = []
    status = run_headless(camera, 0.3, tmp_path / "window.png", finished)
    assert status == 0
    assert finished[0].wavefront is not None
    image = QImage(str(tmp_path / "window.png"))
    assert image.width() > 800
    assert len({QColor(image.pixel(x, image.height() // 2)).rgb() for x in range(0, image.width(), 7)}) > 10
    assert camera.is_closed
    assert qapp is QApplication.instance()


@pytest.mark.slow
@pytest.mark.long
def test_full_disk_leaves_no_screenshot(qapp: QApplication, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Qt would report success."""

    def fill_up(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    assert qapp is QApplication.instance()
    monkeypatch.setattr(os, "fsync", fill_up)
    camera = FakeCamera()
    with pytest.raises(RunError, match=r"window\.png: cannot be written"):
        run_headless(camera, 0.1, tmp_path / "window.png")
    assert not list(tmp_path.iterdir())


def test_unattended_run_raises_device_error(qapp: QApplication) -> None:
    camera = FakeCamera()
    camera.fault = Disconnected("no camera was found")
    with pytest.raises(RunError, match=r"^no camera was found"):
        run_headless(camera, 0.3)
    assert qapp is QApplication.instance()


def test_file_that_is_not_saved_when_the_window_closes_is_told(
    qapp: QApplication, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    disk = threading.Event()
    monkeypatch.setattr("app.gui.widgets.file_work._CLOSING_S", 0.05)
    monkeypatch.setattr("app.gui.widgets.copies.write_csv", lambda *_: disk.wait())
    monkeypatch.setattr(QFileDialog, "getSaveFileName", lambda *_: ("numbers.csv", ""))

    def open_first(window: MainWindow) -> None:
        save_numbers(window, "x\n1", "numbers.csv")
        QTimer.singleShot(0, qapp.closeAllWindows)

    try:
        assert run_window(open_first) == 1
    finally:
        disk.set()
    assert "numbers.csv: not saved: the disk has not answered when the window was closed" in capsys.readouterr().err


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("run", [run_attended, partial(run_headless, seconds=HANG_S)])
def test_signal_closes_window_and_turns_light_off(
    qapp: QApplication, number: signal.Signals, run: Callable[[FakeCamera], int]
) -> None:
    assert qapp is QApplication.instance()
    camera = FakeCamera()
    before = signal.getsignal(number)
    with when_lit(camera, lambda: signal.raise_signal(number)), pytest.raises(Interrupted):
        run(camera)
    assert camera.is_closed
    assert not camera.light.shines
    assert signal.getsignal(number) == before


def test_unattended_run_closed_early_raises_and_saves_nothing(qapp: QApplication, tmp_path: Path) -> None:
    camera = FakeCamera()
    finished: list[Measurement] = []
    with when_lit(camera, qapp.closeAllWindows), pytest.raises(RunError, match="closed before the run had finished"):
        run_headless(camera, HANG_S, tmp_path / "window.png", finished)
    assert not finished
    assert not list(tmp_path.iterdir())
    assert camera.is_closed
