"""The key of the light while a field has the focus: it switches off, never on, and no field keeps it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from PyQt6.QtCore import QPoint, QSettings, Qt
from PyQt6.QtGui import QAction
from PyQt6.QtWidgets import QAbstractSpinBox, QDialog, QLineEdit, QWidget
from pyqtgraph import GraphicsView
from pytestqt.qtbot import QtBot
from support.gui_bench import FakeCamera
from support.window_tools import click, press
from test_law_of_light import activate, focused, switch_off

from app.gui.shell.device_dialogs import DevicePresets
from app.gui.shell.main_window import MainWindow


@pytest.mark.slow
@pytest.mark.parametrize("field", ["name", "current"])
def test_light_key_is_never_swallowed(
    live: tuple[MainWindow, FakeCamera], qtbot: QtBot, tmp_path: Path, field: str
) -> None:
    window, camera = live
    window.recording_bar.recordings_folder = tmp_path
    activate(window, qtbot)
    for stage in ("recording", "finished"):
        press(qtbot, window, Qt.Key.Key_W)
        qtbot.waitUntil(lambda stage=stage: window.recording_bar._stage == stage)  # type: ignore[misc] # mypy and defaults
    if field == "name":
        window.recording_bar.name.setFocus()  # as by a click
    else:
        window.controls.current.edit()
    guide = window.guide
    guide.show()
    activate(guide, qtbot)
    guide.close()
    activate(window, qtbot)
    press(qtbot, focused(window), Qt.Key.Key_L)
    qtbot.waitUntil(lambda: not camera.light.shines)
    assert not window.recording_bar.name.text()
    assert [path.name[-2:] != "-l" for path in tmp_path.iterdir()] == [True]


def test_number_field_leaves_the_light_key_alone(live: tuple[MainWindow, FakeCamera], qtbot: QtBot) -> None:
    window, camera = live
    activate(window, qtbot)
    window.controls.exposure.edit()
    qtbot.waitUntil(window.controls.exposure.hasFocus)
    press(qtbot, window.controls.exposure, Qt.Key.Key_L)
    qtbot.waitUntil(lambda: not camera.light.shines)


def test_strip_says_that_an_l_in_the_name_switches_the_light_off(
    live: tuple[MainWindow, FakeCamera], qtbot: QtBot
) -> None:
    window, camera = live
    activate(window, qtbot)
    window.recording_bar.prepare()
    press(qtbot, focused(window), Qt.Key.Key_L)
    assert window.recording_bar.name.text() == "l"
    said = "L switches the light off, also where it is typed; Shift+L only types it"
    qtbot.waitUntil(lambda: said in window.messages.text.text())
    qtbot.waitUntil(lambda: not camera.light.shines)


@pytest.mark.parametrize("elsewhere", ["camera image", "button"])
def test_click_elsewhere_gives_the_light_its_key_back(
    live: tuple[MainWindow, FakeCamera], qtbot: QtBot, elsewhere: str
) -> None:
    window, camera = live
    activate(window, qtbot)
    window.recording_bar.prepare()
    name = window.recording_bar.name
    click(qtbot, name, QPoint(5, 5))
    press(qtbot, focused(window), Qt.Key.Key_W)
    assert name.text() == "w"  # is typed
    graphics = window.panels.camera.findChild(GraphicsView)
    clicked = window.controls.sample if elsewhere == "button" else graphics and graphics.viewport()
    assert isinstance(clicked, QWidget)
    click(qtbot, clicked, QPoint(5, 5))
    assert focused(window) is not name
    press(qtbot, focused(window), Qt.Key.Key_L)
    qtbot.waitUntil(lambda: not camera.light.shines)
    assert name.text() == "w"


def test_opening_the_recording_bar_leaves_the_light_its_key(live: tuple[MainWindow, FakeCamera], qtbot: QtBot) -> None:
    window, camera = live
    activate(window, qtbot)
    window.recording_bar.prepare()
    press(qtbot, focused(window), Qt.Key.Key_L)
    qtbot.waitUntil(lambda: not camera.light.shines)


def preset_name(window: MainWindow) -> QWidget:
    dialog = DevicePresets(window.controller, window.controls, QSettings(), window)
    dialog.show()
    return dialog.name


def settings_line(window: MainWindow, *, is_number: bool) -> QWidget:
    window.benches.edit()
    dialog = window.benches.settings_dialog
    assert dialog is not None
    kinds = {"number", "integer"} if is_number else {"text"}
    for index in range(dialog.pages.count()):
        dialog.sections.setCurrentRow(index)
        lines = (
            line
            for field, line in dialog.editors.values()
            if field.kind in kinds and line.isVisible() and line.isEnabled()
        )
        if (found := next(lines, None)) is not None:
            return found
    raise AssertionError


FIELDS: dict[str, tuple[Callable[[MainWindow], QWidget], bool]] = {  # and whether it takes letters
    "stop after": (lambda window: window.recording_bar.stop_after, False),
    "recording's name": (lambda window: window.recording_bar.name, True),
    "recording's note": (lambda window: window.recording_bar.note, True),
    "exposure": (lambda window: window.controls.exposure, False),
    "frames": (lambda window: window.controls.frames, False),
    "preset's name": (preset_name, True),
    "number in the settings": (lambda window: settings_line(window, is_number=True), False),
    "text in the settings": (lambda window: settings_line(window, is_number=False), True),
}


@pytest.mark.slow
@pytest.mark.usefixtures("no_rest")
def test_letter_in_a_field_switches_the_light_off_and_never_on(
    live: tuple[MainWindow, FakeCamera], qtbot: QtBot
) -> None:
    window, camera = live
    window.recording_bar.prepare()
    for name, (find, takes_letters) in FIELDS.items():
        if not camera.light.shines:
            window.controls.light.click()
        qtbot.waitUntil(lambda: window.controls.light.text() == "Light on" and window.controller.is_settled)
        field = find(window)
        activate(field.window(), qtbot)  # type: ignore[arg-type] # it has one
        field.setFocus()
        before = text_of(field)
        press(qtbot, field, Qt.Key.Key_L)
        qtbot.waitUntil(lambda: not camera.light.shines)
        qtbot.waitUntil(lambda: window.controls.light.text() == "Light off" and window.controller.is_settled)
        press(qtbot, field, Qt.Key.Key_L)
        qtbot.wait(200)
        assert not camera.light.shines, name
        assert text_of(field).lower().count("l") - before.lower().count("l") == (2 if takes_letters else 0), name
        if isinstance(dialog := field.window(), QDialog):
            dialog.close()


def text_of(field: QWidget) -> str:
    assert isinstance(field, QLineEdit | QAbstractSpinBox)
    return field.text()


@pytest.mark.slow
def test_name_is_typed_in_the_dark_after_its_key(live: tuple[MainWindow, FakeCamera], qtbot: QtBot) -> None:
    window, camera = live
    switch_off(window, qtbot)
    qtbot.keyClick(window, Qt.Key.Key_W, Qt.KeyboardModifier.ShiftModifier)  # type: ignore[no-untyped-call] # pytest-qt declares no types
    for letter in "MOLE":
        press(qtbot, focused(window), Qt.Key(ord(letter)))
    assert window.recording_bar.name.text() == "mole"
    qtbot.wait(1200)
    assert not camera.light.shines


@pytest.mark.slow
@pytest.mark.usefixtures("no_rest")
def test_menu_switches_the_light_on_although_a_field_has_the_focus(
    live: tuple[MainWindow, FakeCamera], qtbot: QtBot
) -> None:
    window, camera = live
    switch_off(window, qtbot)
    window.recording_bar.prepare()
    press(qtbot, focused(window), Qt.Key.Key_L)
    next(one for one in window.findChildren(QAction) if one.text() == "Light on").trigger()
    qtbot.waitUntil(lambda: camera.light.shines)
    assert window.recording_bar.name.text() == "l"


@pytest.mark.slow
def test_stopping_a_recording_leaves_its_name(
    live: tuple[MainWindow, FakeCamera], qtbot: QtBot, tmp_path: Path
) -> None:
    window, _ = live
    window.recording_bar.recordings_folder = tmp_path
    activate(window, qtbot)
    press(qtbot, window, Qt.Key.Key_W)
    qtbot.waitUntil(lambda: window.recording_panel.record.text() == "Stop recording")
    window.recording_bar.stop_after.setFocus()
    window.recording_panel.record.click()
    assert focused(window) is window
    qtbot.waitUntil(lambda: window.recording_bar._stage == "finished")
    assert focused(window) is window


def test_hidden_field_gives_the_focus_to_the_window(live: tuple[MainWindow, FakeCamera], qtbot: QtBot) -> None:
    window, _ = live
    activate(window, qtbot)
    window.recording_bar.prepare()
    window.recording_bar.stop_after.setFocus()
    window.recording_bar.hide()
    assert focused(window) is window


@pytest.mark.slow
def test_number_lines_of_the_settings_take_tab_and_leave_the_light_key_alone(
    live: tuple[MainWindow, FakeCamera], qtbot: QtBot
) -> None:
    window, camera = live
    window.benches.edit()
    dialog = window.benches.settings_dialog
    assert dialog is not None
    activate(dialog, qtbot)
    for _ in range(50):
        press(qtbot, focused(dialog), Qt.Key.Key_Tab)
        if isinstance(focused(dialog), QLineEdit):
            break
    line = focused(dialog)
    assert isinstance(line, QLineEdit)
    before = line.text()
    press(qtbot, line, Qt.Key.Key_L)
    qtbot.waitUntil(lambda: not camera.light.shines)
    assert line.text() == before
    dialog.close()
