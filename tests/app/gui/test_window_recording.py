"""Recording in the window."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from PyQt6.QtCore import QSettings, Qt
from PyQt6.QtGui import QCloseEvent
from PyQt6.QtWidgets import QApplication
from pytestqt.qtbot import QtBot
from support.gui_bench import FakeCamera
from support.window_tools import MakeWindow, press, wait_for_wavefront

from app.acquisition.worker import Acquisition
from app.gui.shell.main_window import MainWindow
from app.recording.reader import Recording
from drivers.interface import Disconnected


def only_recording(folder: Path, suffix: str = "") -> Recording:
    (found,) = (path for path in folder.iterdir() if path.name.endswith("-kept") == (suffix == "-kept"))
    return Recording(found)


@pytest.mark.slow
@pytest.mark.long
def test_every_frame_between_start_and_stop_is_recorded(
    live: tuple[MainWindow, FakeCamera], qtbot: QtBot, tmp_path: Path
) -> None:
    window, _ = live
    window.recording_bar.recordings_folder = tmp_path / "here"
    panel = window.recording_panel
    press(qtbot, window, Qt.Key.Key_W)
    qtbot.waitUntil(lambda: panel.record.text() == "Stop REC")
    qtbot.waitUntil(lambda: panel.text.text().startswith("REC 0:0") and int(panel.text.text().split()[2]) > 5)
    qtbot.waitUntil(lambda: "disk space for" in panel.text.toolTip())
    press(qtbot, window, Qt.Key.Key_W)
    window.messages.accept.click()  # the key asks
    qtbot.waitUntil(lambda: "Recorded" in window.messages.text.text())
    assert panel.record.text() == "Record"
    recording = only_recording(tmp_path / "here")
    assert recording.is_complete
    assert len(recording) == int(window.messages.text.text().split(" ")[1]) > 5
    assert recording.displacement(3) is not None


@pytest.mark.slow
@pytest.mark.long
def test_last_seconds_are_saved(live: tuple[MainWindow, FakeCamera], qtbot: QtBot, tmp_path: Path) -> None:
    window, _ = live
    window.recording_bar.recordings_folder = tmp_path
    acquisition = window.controller.acquisition
    assert acquisition is not None
    qtbot.waitUntil(lambda: acquisition.counts.acquired > 2)
    press(qtbot, window, Qt.Key.Key_K)
    qtbot.waitUntil(lambda: "Recorded" in window.messages.text.text())
    assert len(only_recording(tmp_path, "-kept")) > 1


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize("name", ["file", "file/below", "a" * 300])  # the last exceeds any file system's limit
def test_impossible_folder_is_reported(
    live: tuple[MainWindow, FakeCamera], qtbot: QtBot, tmp_path: Path, name: str
) -> None:
    window, _ = live
    (tmp_path / "file").write_text("no folder")
    window.recording_bar.recordings_folder = tmp_path / name
    window.recording_bar._disk_due_s = 0.0  # query the disk space at once
    window.recording_panel.record.click()
    qtbot.waitUntil(lambda: str(tmp_path / name[:4]) in window.messages.text.text())
    qtbot.waitUntil(lambda: not window.recording_panel.record.isChecked())
    assert not window.controller.failure
    assert list(tmp_path.iterdir()) == [tmp_path / "file"]


@pytest.mark.slow
@pytest.mark.long
def test_unplugged_camera_leaves_a_complete_recording(make_window: MakeWindow, qtbot: QtBot, tmp_path: Path) -> None:
    first, second = FakeCamera(), FakeCamera()
    window = make_window(first, second)
    window.recording_bar.recordings_folder = tmp_path
    window.connect_devices()
    wait_for_wavefront(qtbot, window)
    window.recording_panel.record.click()
    qtbot.waitUntil(lambda: window.recording_panel.record.text() == "Stop REC")
    before = first._index
    qtbot.waitUntil(lambda: first._index > before + 5)
    first.fault = Disconnected("the camera was unplugged")
    qtbot.waitUntil(window.messages.reconnect.isVisible)
    assert not first.light.shines
    qtbot.waitUntil(lambda: only_recording(tmp_path).is_complete)
    recording = only_recording(tmp_path)
    assert "unplugged" in recording.ended_early
    assert len(recording) > 5
    window.messages.reconnect.click()
    wait_for_wavefront(qtbot, window)
    qtbot.waitUntil(lambda: not window.messages.reconnect.isVisible())


@pytest.mark.slow
@pytest.mark.long
def test_early_end_is_shown_until_dismissed(live: tuple[MainWindow, FakeCamera], qtbot: QtBot, tmp_path: Path) -> None:
    window, camera = live
    window.recording_bar.recordings_folder = tmp_path
    window.recording_panel.record.click()
    qtbot.waitUntil(lambda: window.recording_panel.record.text() == "Stop REC")
    acquisition = window.controller.acquisition
    assert isinstance(acquisition, Acquisition)
    acquisition._recorder.stop("the disk is full")
    qtbot.waitUntil(window.messages.dismiss.isVisible)
    assert "the disk is full" in window.messages.text.text()
    assert camera.light.shines  # only the recording has ended
    press(qtbot, window, Qt.Key.Key_Escape)
    qtbot.waitUntil(lambda: not window.messages.dismiss.isVisible())


def close_as_the_window_system_does(window: MainWindow) -> None:
    """Its event reaches Qt's window, not the widget."""
    QApplication.sendEvent(window.windowHandle(), QCloseEvent())


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize("close", [MainWindow.close, MainWindow.quit, close_as_the_window_system_does])
def test_closing_the_window_finishes_the_recording(
    make_window: MakeWindow,
    qtbot: QtBot,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
    close: Callable[[MainWindow], object],
) -> None:
    settings, camera = QSettings(str(tmp_path / "settings.ini"), QSettings.Format.IniFormat), FakeCamera()
    window = make_window(camera, saved=settings)
    window.connect_devices()
    wait_for_wavefront(qtbot, window)
    window.recording_bar.recordings_folder = tmp_path / "runs"
    window.recording_panel.record.click()
    qtbot.waitUntil(lambda: window.recording_panel.record.text() == "Stop REC")
    close(window)
    close(window)  # a second click meanwhile
    qtbot.waitUntil(lambda: not window.isVisible())
    assert only_recording(tmp_path / "runs").is_complete
    assert window.controller.acquisition is not None
    assert not window.controller.acquisition.is_alive
    assert camera.is_closed
    assert not camera.light.shines
    assert settings.contains("window/panels")
    assert "cannot schedule new futures" not in "".join(capfd.readouterr())
