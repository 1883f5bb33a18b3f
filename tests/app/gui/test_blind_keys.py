"""Keys typed without looking: a recording, the light and the bench survive them."""

from __future__ import annotations

import string
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PyQt6.QtCore import Qt
from PyQt6.QtTest import QTest
from PyQt6.QtWidgets import QApplication, QLineEdit
from pytestqt.qtbot import QtBot
from support.gui_bench import FakeCamera
from support.window_tools import acquisition_of, press

from app.gui.shell.main_window import MainWindow
from app.recording.reader import Recording

_KEYS: tuple[Any, ...] = (
    *(character for character in string.printable if character.isprintable()),
    *(Qt.Key.Key_Return, Qt.Key.Key_Escape, Qt.Key.Key_Backspace, Qt.Key.Key_Delete),
    *(Qt.Key.Key_Left, Qt.Key.Key_Right, Qt.Key.Key_Up, Qt.Key.Key_Down),
)


def begin_recording(window: MainWindow, qtbot: QtBot, folder: Path) -> Path:
    window.recording_bar.recordings_folder = folder
    window.activateWindow()
    qtbot.waitUntil(window.isActiveWindow)
    window.recording_panel.record.click()
    qtbot.waitUntil(lambda: window.recording_panel.text.text().startswith("REC "))
    (made,) = folder.iterdir()
    return made


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_blind_keys_lose_nothing(live: tuple[MainWindow, FakeCamera], qtbot: QtBot, tmp_path: Path, seed: int) -> None:
    window, camera = live
    folder, typed = begin_recording(window, qtbot, tmp_path), np.random.default_rng(seed)
    before = window.controller.status
    assert before is not None
    for _ in range(2000):
        target = QApplication.focusWidget() or QApplication.activeWindow() or window
        key = _KEYS[typed.integers(len(_KEYS))]
        if key in {"l", "L"} and not isinstance(target, QLineEdit):
            continue
        QTest.keyClick(target, key)  # type: ignore[call-overload] # PyQt's stub lacks staticmethod
        assert camera.light.shines, key
    qtbot.waitUntil(lambda: window.controller.is_settled)
    after = window.controller.status
    assert after is not None
    assert (after.bench, after.dark, after.reference, after.lattice) == (
        before.bench,
        before.dark,
        before.reference,
        before.lattice,
    )
    assert (after.is_running, after.is_sample_in, after.exposure_s) == (True, before.is_sample_in, before.exposure_s)
    state = acquisition_of(window).recording
    assert state is not None
    assert (state.stage, state.folder, state.gaps) == ("recording", folder, ())
    window.recording_panel.record.click()
    qtbot.waitUntil(lambda: window.recording_bar.folder is not None)
    assert window.recording_bar.folder is not None
    recorded = Recording(window.recording_bar.folder)
    assert recorded.is_complete
    assert len(recorded) == recorded.recorded_frames


def test_key_of_a_command_asks_while_frames_are_recorded(
    live: tuple[MainWindow, FakeCamera], qtbot: QtBot, tmp_path: Path
) -> None:
    window, camera = live
    begin_recording(window, qtbot, tmp_path)
    press(qtbot, window, Qt.Key.Key_S)
    window.update_text()
    assert window.messages.text.text() == "Sample in, while frames are recorded?"
    press(qtbot, window, Qt.Key.Key_Return)  # typed by mistake, too
    assert camera.stage.is_sample_in
    qtbot.keyClick(window, Qt.Key.Key_Return, Qt.KeyboardModifier.ControlModifier)  # type: ignore[no-untyped-call] # pytest-qt declares no types for it
    qtbot.waitUntil(lambda: not camera.stage.is_sample_in)
    press(qtbot, window, Qt.Key.Key_W)
    window.update_text()
    window.messages.accept.click()
    qtbot.waitUntil(lambda: window.recording_bar.folder is not None)
    press(qtbot, window, Qt.Key.Key_S)  # nothing is recorded
    qtbot.waitUntil(lambda: camera.stage.is_sample_in)
