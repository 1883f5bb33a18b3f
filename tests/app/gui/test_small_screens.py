"""Full HD screens at scale 2 and other small ones: every dialog fits, plots take turns with the camera, texts wrap."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import pytest
from PyQt6.QtCore import QPoint, QRect, QSettings, QSize
from PyQt6.QtGui import QAction, QFont, QScreen
from PyQt6.QtWidgets import QApplication, QDialog, QPushButton
from pytestqt.qtbot import QtBot
from support.gui_bench import make_measurement
from support.window_tools import MakeWindow, dim_frame, tabs, views

from app.gui.shell.main_window import MainWindow
from app.gui.shell.recording import RecordingPanel
from app.gui.widgets.plot import Plot
from app.gui.widgets.texts import ElidedLabel
from app.recording.recorder import RecordingState

SCREEN = QRect(0, 0, 960, 540)  # 1920 x 1080 pixels at scale 2
DIALOGS = {
    "Shortcuts and conventions",
    "Message log",
    "Documentation",
    "How to cite",
    "About svwfs",
    "Preferences",
    "Presets of exposure and mask",
    "Settings of the bench",
    "New bench from my camera",
    "Enlarge the selected view",
}


@pytest.fixture
def settings(tmp_path: Path) -> QSettings:
    return QSettings(str(tmp_path / "settings.ini"), QSettings.Format.IniFormat)


@pytest.fixture
def small_screen(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(QScreen, "availableGeometry", lambda _: SCREEN)


@pytest.fixture(params=[1.0, 1.25])
def font_size(qapp: QApplication, request: pytest.FixtureRequest) -> Iterator[float]:
    usual = QFont(qapp.font())
    font = QFont(usual)
    font.setPointSizeF(request.param * usual.pointSizeF())
    qapp.setFont(font)
    yield request.param
    qapp.setFont(usual)


def settle() -> None:
    for _ in range(4):  # one layout triggers others
        QApplication.processEvents()


def low_window(make_window: MakeWindow, settings: QSettings | None = None) -> MainWindow:
    window = make_window(saved=settings)
    window.show_measurement(make_measurement(dim_frame(), views()))
    window.resize(SCREEN.size())
    settle()
    return window


def check_fits(dialog: QDialog) -> None:
    """Check that a dialog with its frame fits on the screen, and that all its buttons are within it."""
    assert dialog.width() <= SCREEN.width(), dialog.windowTitle()
    assert dialog.height() <= SCREEN.height() - 40, dialog.windowTitle()
    for button in dialog.findChildren(QPushButton):
        if button.isVisible():
            place = QRect(button.mapTo(dialog, QPoint()), button.size())
            assert dialog.rect().contains(place), (dialog.windowTitle(), button.text())


@pytest.mark.usefixtures("small_screen", "font_size")
def test_every_dialog_fits_on_the_screen(make_window: MakeWindow, qtbot: QtBot, settings: QSettings) -> None:
    window = low_window(make_window, settings)
    seen: set[str] = set()
    for action in window.findChildren(QAction):
        if action.text() in DIALOGS - seen:
            seen.add(action.text())
            action.trigger()
            settle()
            (dialog,) = [one for one in window.findChildren(QDialog) if one.isVisible()]
            check_fits(dialog)
            dialog.close()
    assert seen == DIALOGS
    guide = window.guide
    guide.begin(20)
    settle()
    check_fits(guide)
    for bar in (guide.steps.verticalScrollBar(), guide.steps.horizontalScrollBar()):
        assert bar is not None
        assert not bar.isVisible()
    guide.close()
    form = window.benches.settings_dialog
    assert form is not None
    qtbot.waitUntil(lambda: form._search is None)  # the search of the new bench


def test_camera_and_plots_take_turns_in_a_low_window(make_window: MakeWindow) -> None:
    window = low_window(make_window)
    camera, quality = window.panels.camera, window.panels.quality
    assert camera.isVisible()
    assert camera._graphics.height() > 220
    assert not quality.isVisible()
    assert camera.arrows_toggle.isVisible()  # its header stays
    for panel in tabs(window).values():
        window.docks.show_panel(panel)
        settle()
        assert panel.isVisible()
        assert panel.height() > 180
        assert not camera.isVisible()
    window.resize(1280, 800)
    settle()
    assert camera.isVisible()
    shown_last = list(tabs(window).values())[-1]
    assert shown_last.isVisible()
    assert camera.mapTo(window, QPoint()).y() < shown_last.mapTo(window, QPoint()).y()
    window.resize(SCREEN.size())
    settle()
    window.docks.restore_default()
    settle()
    assert camera.isVisible()
    assert not quality.isVisible()


def test_low_window_remembers_the_layout_of_a_tall_one(make_window: MakeWindow, settings: QSettings) -> None:
    low_window(make_window, settings).close()
    window = make_window(saved=settings)
    window.resize(1280, 800)
    settle()
    assert window.panels.camera.isVisible()
    assert window.panels.quality.isVisible()


@pytest.mark.usefixtures("small_screen")
def test_recording_bar_and_times_fit_into_a_low_window(make_window: MakeWindow) -> None:
    window = low_window(make_window)
    window.recording_bar.prepare()
    window.status_line.toggle_times()
    settle()
    assert window.width() <= SCREEN.width()
    assert window.height() <= SCREEN.height() - 40  # for the frame
    assert window.rect().bottom() >= window.status_line.mapTo(window, window.status_line.rect().bottomLeft()).y()


def test_docks_take_all_room_above_the_controls(make_window: MakeWindow) -> None:
    window = make_window()
    window.resize(1280, 800)
    settle()
    window.recording_bar.prepare()
    settle()
    window.recording_bar.hide()
    settle()
    controls = window.docks._at("strip").geometry()
    for panel in ("left", "right"):
        assert window.docks._at(panel).isVisible()
    assert controls.top() - window.docks._at("right").geometry().bottom() < 16  # the handle between both


def test_text_takes_a_second_line_and_then_an_ellipsis(qtbot: QtBot) -> None:
    made = ElidedLabel(lines=2)
    qtbot.addWidget(made)
    made.resize(120, 20)
    made.show()
    made.setText("short")
    line = made.minimumHeight()
    assert made.shown == "short"
    made.setText("one layer in front of the lenslets")
    assert made.shown.count("\n") == 1
    assert made.shown.replace("\n", "").rstrip() == "one layer in front of the lenslets"
    assert made.minimumHeight() == 2 * line
    made.setText("one layer in front of the lenslets: some of the displacements are unexplained")
    assert made.shown.count("\n") == 1
    assert made.shown.endswith("\N{HORIZONTAL ELLIPSIS}")
    made.setText("short")
    assert made.minimumHeight() == 2 * line  # nothing jumps
    made.resize(400, 20)
    settle()
    assert made.minimumHeight() == line


def test_disk_space_gives_way_to_what_happens_in_the_recording(qtbot: QtBot) -> None:
    panel = RecordingPanel()
    qtbot.addWidget(panel)
    state = RecordingState(Path("run"), "recording", 123456, 1234, 3600.0, math.inf, "")
    panel.show_state(state, 58.0)
    assert panel.text.text() == "123456 frames   60:00   1234 waiting for the disk"
    assert "58 min" in panel.text.toolTip()
    panel.show_state(None, 58.0)
    assert panel.text.text() == "disk space for 58 min"


@pytest.mark.parametrize("size", [QSize(130, 75), QSize(300, 300)])
def test_numbers_of_an_axis_never_touch(qtbot: QtBot, size: QSize) -> None:
    plot = Plot("", "distance (mm)", widest="100")
    qtbot.addWidget(plot)
    plot.resize(size)
    plot.show()
    plot.set_ranges((-200, 400), (0, 85))
    settle()
    font = plot.fontMetrics()
    for side, axis in plot.axes.items():
        room = axis.height() if side == "left" else axis.width()
        low, high = axis.range
        _, values = axis.tickValues(low, high, room)[0]
        texts = axis.tickStrings(list(values), 1, 1)
        needed = font.height() if side == "left" else max(map(font.horizontalAdvance, texts))
        assert len(values) <= 1 or room * (values[1] - values[0]) / (high - low) >= needed


@pytest.mark.parametrize("title", ["Layers", "Corrector"])
def test_slow_panels_say_that_they_are_at_work(make_window: MakeWindow, title: str) -> None:
    window = make_window()
    panel = window.panels.layers if title == "Layers" else window.panels.corrector
    assert panel.sentence.text().endswith("ing \N{HORIZONTAL ELLIPSIS}")
    assert all(axis._tickLevels == [[]] for axis in panel.plot.axes.values())  # no numbers
    panel.plot.set_ranges((0, 1), (0, 1))
    assert all(axis._tickLevels is None for axis in panel.plot.axes.values())
