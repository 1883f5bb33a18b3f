"""Recordings that something else would end, and requests that come while one starts."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest
from PyQt6.QtCore import Qt
from pytestqt.qtbot import QtBot
from support.gui_bench import BENCH, FakeCamera, opener
from support.patience import HANG_S
from support.window_tools import acquisition_of, press, wait_for_wavefront

from app.acquisition.worker import Acquisition
from app.gui.shell.main_window import MainWindow
from app.gui.widgets import theme
from app.recording.reader import Recording
from app.results.player import InstrumentFactory


@pytest.fixture
def recording(live: tuple[MainWindow, FakeCamera], qtbot: QtBot, tmp_path: Path) -> MainWindow:
    """A window that records."""
    window, _ = live
    window.recording_bar.recordings_folder = tmp_path / "runs"
    press(qtbot, window, Qt.Key.Key_W)
    qtbot.waitUntil(lambda: stage(window) == "recording")
    return window


def stage(window: MainWindow) -> str:
    acquisition = window.controller.acquisition
    return "" if acquisition is None or acquisition.recording is None else acquisition.recording.stage


@pytest.mark.slow
@pytest.mark.long
def test_another_bench_waits_for_an_answer(recording: MainWindow, qtbot: QtBot, tmp_path: Path) -> None:
    window, opened = recording, list[FakeCamera]()

    def make() -> Acquisition:
        opened.append(FakeCamera())
        return Acquisition(BENCH, opener(opened[-1]))

    window.open(InstrumentFactory(make))
    window.update_text()
    assert "ends if another bench is opened" in window.messages.text.text()
    assert window.messages.text.property("tone") == theme.tone(theme.AMBER)
    assert window.messages.accept.toolTip() == "Accept (Ctrl+Return)"
    press(qtbot, window, Qt.Key.Key_Return)
    assert window.messages.accept.isVisible()  # the question is still open
    window.messages.discard.click()
    assert stage(window) == "recording"
    assert not opened

    window.recording_bar.note.setText("a note of the first bench")
    window.open(InstrumentFactory(make))
    window.update_text()
    window.messages.accept.click()
    assert len(opened) == 1
    wait_for_wavefront(qtbot, window)
    assert "ends if another bench is opened" in window.messages.log
    assert window.messages.log.count("Recorded ") == 1
    (folder,) = (tmp_path / "runs").iterdir()
    assert Recording(folder).is_complete
    assert Recording(folder).run["note"] == "a note of the first bench"


@pytest.mark.slow
@pytest.mark.long
def test_note_is_kept_when_the_window_closes(recording: MainWindow, tmp_path: Path) -> None:
    recording.recording_bar.note.setText("the last words")
    recording.close()
    (folder,) = (tmp_path / "runs").iterdir()
    assert Recording(folder).run["note"] == "the last words"


@pytest.mark.slow
@pytest.mark.long
def test_second_request_ends_a_recording_that_has_not_begun(
    live: tuple[MainWindow, FakeCamera], qtbot: QtBot, tmp_path: Path
) -> None:
    window, _ = live
    window.recording_bar.recordings_folder = tmp_path / "runs"
    release = threading.Event()
    held = acquisition_of(window).commands.submit(lambda _: release.wait(HANG_S))
    press(qtbot, window, Qt.Key.Key_W)
    window.update_text()
    assert window.recording_panel.record.text() == "Stop REC"
    press(qtbot, window, Qt.Key.Key_W)
    window.messages.accept.click()  # the key asks
    release.set()
    held.result(HANG_S)
    qtbot.waitUntil(lambda: window.controller.is_settled)
    window.update_text()
    assert window.recording_panel.record.text() == "Record"
    assert stage(window) == ""
    assert not (tmp_path / "runs").exists()
