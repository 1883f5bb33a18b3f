"""Layout of the window: what the wavefronts take, what a recording looks like, names for screen readers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PyQt6.QtCore import Qt
from PyQt6.QtGui import QAction
from PyQt6.QtWidgets import QAbstractButton, QAbstractSpinBox, QApplication, QComboBox, QDialog, QFileDialog, QWidget
from pytestqt.qtbot import QtBot
from support.gui_bench import FakeCamera, make_measurement
from support.window_tools import LENSLETS, MakeWindow, acquisition_of, click, dim_frame, picture, press, tabs, views
from test_view_grid import show

from app.gui.shell.main_window import MainWindow
from app.gui.widgets import theme
from app.gui.widgets.theme import styled_application
from app.recording.reader import Recording
from reconstruction.displacement import LensletStatus

# They close, write or ask before others; the fake camera has one region.
_UNTRIED = {"Quit", "Save a screenshot", "Start or stop recording", "Choose the sensor region\N{HORIZONTAL ELLIPSIS}"}


def settle() -> None:
    for _ in range(4):  # one layout triggers others
        QApplication.processEvents()


@pytest.mark.usefixtures("restored_theme")
@pytest.mark.parametrize(("size", "share"), [((1280, 720), 0.30), ((1920, 1080), 0.35)])
def test_nine_wavefronts_take_their_share_of_the_window(
    make_window: MakeWindow, size: tuple[int, int], share: float
) -> None:
    styled_application()
    window = make_window()
    window.resize(*size)
    window.docks.restore_default()
    grid = window.panels.wavefronts.grid
    show(grid, np.zeros((3, 3, 15, 15)), 1.0)
    grid.set_captions(dict.fromkeys(np.ndindex(3, 3), (("RMS 1.234 rad", ""), ("", ""))))
    settle()
    tiles = [grid.places.tile(row, column) for row, column in np.ndindex(3, 3)]
    assert all(grid.rect().contains(tile) for tile in tiles)
    assert sum(tile.width() * tile.height() for tile in tiles) >= share * size[0] * size[1]
    assert (window.width(), window.height()) == size


@pytest.mark.slow
def test_ten_frames_are_recorded_with_four_clicks(
    live: tuple[MainWindow, FakeCamera], qtbot: QtBot, tmp_path: Path
) -> None:
    window, _ = live
    bar, window.recording_bar.recordings_folder = window.recording_bar, tmp_path
    menu = next(one for one in window.findChildren(QAction) if one.text().startswith("Name, note"))
    menu.trigger()  # two clicks: the menu, the entry
    settle()
    bar.stop_after.edit()  # the third
    qtbot.keyClicks(bar.stop_after, "10")  # type: ignore[no-untyped-call] # pytest-qt declares no types for it
    press(qtbot, bar.stop_after, Qt.Key.Key_Return)
    click(qtbot, window.recording_panel.record, window.recording_panel.record.rect().center())
    qtbot.waitUntil(lambda: bar.folder is not None)
    assert bar.folder is not None
    assert len(Recording(bar.folder)) == 10


@pytest.mark.slow
def test_recording_has_a_red_frame_and_its_time_and_frames(
    live: tuple[MainWindow, FakeCamera], qtbot: QtBot, tmp_path: Path
) -> None:
    window, _ = live
    window.recording_bar.recordings_folder = tmp_path
    red = [theme.RED.red(), theme.RED.green(), theme.RED.blue()]

    def is_framed() -> bool:
        seen = picture(window)
        return all((edge == red).all() for edge in (seen[0], seen[-1], seen[:, 0], seen[:, -1]))

    styled_application()
    assert not is_framed()
    window.recording_panel.record.click()
    text = window.recording_panel.text
    qtbot.waitUntil(lambda: text.text().startswith("REC 0:0"))
    qtbot.waitUntil(is_framed)
    assert text.property("tone") == theme.tone(theme.RED)
    window.recording_panel.record.click()
    qtbot.waitUntil(lambda: not is_framed())
    assert acquisition_of(window).recording is not None


def test_verdict_leads_to_a_lost_lenslet(make_window: MakeWindow) -> None:
    window = make_window()
    outcome = np.zeros(LENSLETS, np.int8)
    outcome[3, 4] = LensletStatus.DARK
    window.show_measurement(make_measurement(dim_frame(), views(), outcome=outcome))
    window.update_text()
    assert window.verdict.text().startswith("FAIR")
    window.verdict.click()
    settle()
    assert window.panels.lenslet.lenslet == (3, 4)
    assert window.panels.lenslet.isVisible()


@pytest.mark.slow
def test_verdict_says_why_a_frame_is_bad(live: tuple[MainWindow, FakeCamera], qtbot: QtBot) -> None:
    window, _ = live
    window.controls.sample.click()  # the fake sample bends subimages as no wavefront does
    qtbot.waitUntil(lambda: window.verdict.text().startswith("GOOD "))
    assert "117 of 117" in window.verdict.text()
    window.controls.light.click()
    qtbot.waitUntil(lambda: window.verdict.accessibleName() == "BAD the light is off: switch it on (L)")


def name_of(widget: QWidget) -> str:
    """Name that a screen reader says."""
    text = widget.text() if isinstance(widget, QAbstractButton) else ""
    return widget.accessibleName() or text


@pytest.mark.usefixtures("restored_theme")
def test_every_control_has_a_name(make_window: MakeWindow) -> None:
    window = make_window()
    for panel in tabs(window).values():
        panel.front_requested.emit()
    window.panels.wavefronts.enlarge()
    window.benches.make()
    window.benches.edit("sensor")
    is_reached = Qt.FocusPolicy.TabFocus.value
    controls = [one for one in window.findChildren(QWidget) if one.focusPolicy().value & is_reached]
    controls += window.findChildren(QAbstractButton)
    controls = [one for one in controls if not one.inherits("QListView") or one.inherits("QListWidget")]  # of a choice
    inner = QAbstractSpinBox, QComboBox
    named = [one for one in controls if not isinstance(one.parentWidget(), inner)]  # a field within a field
    named = [one for one in named if not one.objectName().startswith("qt_")]  # parts of Qt's own widgets
    assert len(named) > 60
    unnamed = [f"{type(one).__name__}: {one.toolTip()} {one.parent()}" for one in named if not name_of(one)]
    assert unnamed == []


@pytest.mark.slow
def test_entries_that_open_dialogs_and_no_others_end_in_an_ellipsis(
    live: tuple[MainWindow, FakeCamera], qtbot: QtBot, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    window, _ = live
    window.recording_bar.recordings_folder, opened = tmp_path, list[str]()

    def note(*_: object) -> tuple[str, str]:
        opened.append("file")
        return "", ""

    monkeypatch.setattr(QFileDialog, "getOpenFileName", note)
    monkeypatch.setattr(QFileDialog, "getSaveFileName", note)
    monkeypatch.setattr(QFileDialog, "getExistingDirectory", lambda *_: note()[0])
    qtbot.waitUntil(lambda: window.shown.wavefront is not None)

    def dialogs() -> list[QDialog]:
        return [one for one in window.findChildren(QDialog) if one.isVisible()]

    opens = set[str]()
    menus = [one for bar_entry in window.menu_bar.actions() if (one := bar_entry.menu()) is not None]
    entries = [action for menu in (*menus, window.panels.wavefronts.menu) for action in menu.actions()]
    entries = [action for action in entries if action.menu() is None and action.text() not in {"", *_UNTRIED}]
    for action in entries:
        action.trigger()
        qtbot.waitUntil(lambda: bool(opened or dialogs() or window.controller.is_settled))  # some ask the instrument
        settle()
        if opened or dialogs():
            opens.add(action.text())
        opened.clear()
        for _ in range(2):  # a sequence shows its dialog again when it ends
            for dialog in dialogs():
                dialog.close()
            qtbot.waitUntil(lambda: window.controller.is_settled)
            settle()
    texts = [action.text() for action in entries]
    assert len(texts) > 40
    assert opens == {text for text in texts if text.endswith("\N{HORIZONTAL ELLIPSIS}")}
