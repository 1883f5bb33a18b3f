"""Small screens and large fonts: every dialog fits, no text is cut, and nothing overlaps."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import pytest
from PyQt6.QtCore import QPoint, QRect, QSettings
from PyQt6.QtGui import QAction, QFont, QScreen
from PyQt6.QtWidgets import (
    QApplication,
    QComboBox,
    QDialog,
    QLabel,
    QLineEdit,
    QPushButton,
    QScrollArea,
    QStyle,
    QStyleOptionButton,
    QStyleOptionComboBox,
    QWidget,
)
from pytestqt.qtbot import QtBot
from support.gui_bench import FakeCamera, make_measurement
from support.window_tools import MakeWindow, dim_frame, tabs, views, wait_for_wavefront

from app.gui.panels.panel import DataFreshness
from app.gui.shell.controller import Controller
from app.gui.shell.main_window import MainWindow
from app.gui.shell.recording import RecordingPanel
from app.gui.widgets import theme
from app.gui.widgets.texts import ElidedLabel
from app.gui.widgets.theme import styled_application
from app.measurement.measurement import FrameTotals
from app.recording.recorder import RecordingState

SCREEN = QRect(0, 0, 960, 540)  # 1920 x 1080 pixels at scale 2
DIALOGS = {
    "Shortcuts and conventions…",
    "Message log…",
    "Documentation…",
    "About svwfs…",
    "Preferences…",
    "Settings of the bench…",
    "Enlarge the selected view…",
    "Calibrate step by step…",
}
ELLIPSIS = "\N{HORIZONTAL ELLIPSIS}"
DEATH = (
    "the instrument's process 123456 was ended by SIGKILL: its light should be off; if it shines, switch it off by hand"
    " or with svwfs light-off"
)
LONG = "the recording ended early, 1203 frames are saved: the disk is full, free some space and start another recording"


@pytest.fixture
def small_screen(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(QScreen, "availableGeometry", lambda _: SCREEN)


@pytest.fixture(params=[1.0, 1.25, 1.5])
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


@pytest.mark.usefixtures("small_screen", "font_size")
def test_every_dialog_fits_on_the_screen(make_window: MakeWindow, tmp_path: Path) -> None:
    window = make_window(saved=QSettings(str(tmp_path / "settings.ini"), QSettings.Format.IniFormat))
    window.show_measurement(make_measurement(dim_frame(), views()))
    window.controls.setEnabled(True)
    seen: set[str] = set()
    for action in window.findChildren(QAction):
        if action.text() not in DIALOGS - seen:
            continue
        seen.add(action.text())
        action.trigger()
        settle()
        (dialog,) = [one for one in window.findChildren(QDialog) if one.isVisible()]
        assert dialog.width() <= SCREEN.width(), dialog.windowTitle()
        assert dialog.height() <= SCREEN.height() - 40, dialog.windowTitle()  # for the frame
        for button in dialog.findChildren(QPushButton):
            if button.isVisible():
                place = QRect(button.mapTo(dialog, QPoint()), button.size())
                assert dialog.rect().contains(place), (dialog.windowTitle(), button.text())
        dialog.close()
    assert seen == DIALOGS


@pytest.mark.usefixtures("small_screen", "restored_theme")
def test_camera_is_the_first_tab_on_a_low_screen(make_window: MakeWindow) -> None:
    styled_application()
    window = make_window(resized=False)
    window.recording_bar.prepare()
    settle()
    assert window.panels.camera.isVisible()
    assert not window.panels.quality.isVisible()
    assert window.width() <= SCREEN.width()
    assert window.height() <= SCREEN.height() - 40
    window.panels.quality.front_requested.emit()
    settle()
    assert window.panels.quality.height() > 180
    assert not window.panels.camera.isVisible()


def overlapping(window: MainWindow) -> list[tuple[QWidget, QWidget]]:
    """Return the pairs of panels or texts that lie over each other, or reach beyond the window."""

    def place(widget: QWidget) -> QRect:
        found, around = QRect(widget.mapTo(window, QPoint()), widget.size()), widget.parentWidget()
        while around is not None and around is not window:  # some scroll
            found &= QRect(around.mapTo(window, QPoint()), around.size())
            around = around.parentWidget()
        return found

    panels: list[QWidget] = [window.panels.camera, window.panels.quality, window.panels.wavefronts, window.messages]
    panels += [window.controls, window.status_line, window.recording_panel]
    texts: list[QWidget] = [*window.findChildren(QLabel), window.panels.wavefronts.grid]
    found = list[tuple[QWidget, QWidget]]()
    for group in (panels, texts):
        shown = [one for one in group if one.isVisible() and not place(one).isEmpty()]
        found += [(one, window) for one in shown if not window.rect().contains(place(one))]
        for one, other in combinations(shown, 2):
            is_within = one.isAncestorOf(other) or other.isAncestorOf(one)
            if not is_within and place(one).intersects(place(other)):
                found.append((one, other))
    return found


@pytest.mark.parametrize("size", [(904, 640), (1920, 1080)])
@pytest.mark.usefixtures("font_size")
def test_long_texts_fit(make_window: MakeWindow, size: tuple[int, int]) -> None:
    window = make_window()
    window.resize(*size)
    window.messages.alarm(LONG)
    measurement = make_measurement(dim_frame(), views())
    window.show_measurement(replace(measurement, counts=FrameTotals(1234567, 1204567, 30123), latency_s=0.9876))
    window.update_text()
    settle()
    assert overlapping(window) == []
    assert window.messages.text.toolTip() == LONG.capitalize()
    line = window.status_line
    for value in (line.rate, line.delay, line.lost):
        assert value.width() >= value.fontMetrics().horizontalAdvance(value.text())


def room(control: QWidget) -> int:
    """Width that a control has for its text, px."""
    style = control.style()
    assert style is not None
    if isinstance(control, QComboBox):
        choice = QStyleOptionComboBox()
        control.initStyleOption(choice)
        field = QStyle.SubControl.SC_ComboBoxEditField
        return style.subControlRect(QStyle.ComplexControl.CC_ComboBox, choice, field, control).width()
    if isinstance(control, QPushButton):
        pressed = QStyleOptionButton()
        control.initStyleOption(pressed)
        icon = 0 if control.icon().isNull() else control.iconSize().width() + 4  # px that Qt leaves between
        return style.subElementRect(QStyle.SubElement.SE_PushButtonContents, pressed, control).width() - icon
    return control.contentsRect().width()


def text_of(control: QWidget) -> str:
    if isinstance(control, QComboBox):
        return control.currentText()
    return control.text() if isinstance(control, QLabel | QPushButton | QLineEdit) else ""


def cut_texts(widget: QWidget) -> list[str]:
    """Texts of the visible labels, buttons and choices in a widget that have no room for them."""

    def is_cut(text: str, shown: QWidget) -> bool:
        if isinstance(shown, ElidedLabel):  # it may take more lines
            return shown.shown.endswith(ELLIPSIS) and not text.endswith(ELLIPSIS)
        if isinstance(shown, QLabel) and shown.wordWrap():
            return shown.height() < shown.heightForWidth(shown.width())
        return room(shown) < shown.fontMetrics().horizontalAdvance(text)

    texts = [(text_of(one), one) for one in widget.findChildren(QWidget) if text_of(one) and one.isVisible()]
    return [text for text, one in texts if is_cut(text, one)]


@pytest.mark.slow
@pytest.mark.usefixtures("restored_theme", "font_size")
def test_no_text_in_the_controls_is_cut(make_window: MakeWindow, qtbot: QtBot) -> None:
    styled_application()
    window = make_window(FakeCamera())
    window.connect_devices()
    wait_for_wavefront(qtbot, window)
    window.resize(1, 1)
    settle()
    assert not cut_texts(window.controls)


@pytest.mark.slow
@pytest.mark.usefixtures("restored_theme", "font_size")
def test_no_text_in_any_panel_is_cut(make_window: MakeWindow, qtbot: QtBot) -> None:
    styled_application()
    window = make_window(FakeCamera())
    window.connect_devices()
    wait_for_wavefront(qtbot, window)
    window.resize(1280, 720)
    window.docks.restore_default()
    window.panels.wavefronts.menu.change(removed=frozenset({2, 3}))  # tilt
    window.panels.lenslet.inspect(3, 4)
    for name, panel in tabs(window).items():
        panel.front_requested.emit()
        analysis = window.analyses.of[panel]
        qtbot.waitUntil(lambda analysis=analysis: analysis.request is None or not analysis.is_busy)  # type: ignore[misc] # mypy and defaults
        settle()
        cut = [text for part in (*window.panels, window.status_line) for text in cut_texts(part) if part.isVisible()]
        assert not cut, name
    assert (window.width(), window.height()) == (1280, 720)


@pytest.mark.usefixtures("restored_theme", "font_size")
def test_death_of_the_instrument_is_told_in_full(make_window: MakeWindow, monkeypatch: pytest.MonkeyPatch) -> None:
    styled_application()
    window = make_window()
    window.resize(1280, 720)
    window.docks.restore_default()
    window.show_measurement(make_measurement(dim_frame(), views()))
    monkeypatch.setattr(Controller, "trouble", "instrument gone")
    monkeypatch.setattr(Controller, "is_lost", True)
    window._failure = DEATH
    window.update_text()
    settle()
    assert (
        window.messages.text.shown.replace("\n", "")
        == f"{DEATH[0].upper()}{DEATH[1:]}  \N{EM DASH}  reconnect (Ctrl+R)"
    )


@pytest.mark.usefixtures("restored_theme", "font_size")
def test_doubtful_frame_keeps_its_badge_and_its_number_whole(make_window: MakeWindow, qtbot: QtBot) -> None:
    styled_application()
    window = make_window()
    window.resize(1280, 720)
    window.docks.restore_default()
    window.panels.wavefronts.menu.change(removed=frozenset({2, 3}))  # tilt
    window.show_measurement(make_measurement(dim_frame(), views()))
    summary, camera = window.panels.wavefronts._summary, window.panels.camera
    qtbot.waitUntil(lambda: summary.text().endswith("; no tilt"))
    window.shown.data_freshness = DataFreshness("ANOTHER SAMPLE? SEARCHING", "it contradicts the layers found last")
    for panel in window.panels:
        panel.show_numbers()
    settle()
    assert not cut_texts(camera)
    assert camera.badge.width() <= camera.width()
    assert " rad; no tilt; ANOTHER" in summary.shown.replace("\n", "")


@pytest.mark.usefixtures("restored_theme", "font_size")
def test_verdict_has_room_for_its_reason_and_the_menus_stay(make_window: MakeWindow) -> None:
    styled_application()
    window = make_window()
    window.resize(1280, 720)
    measurement = make_measurement(dim_frame(), views())
    places = []
    for problem in ("", "the reference is missing: take one (R)", "the light is off"):
        window.show_measurement(replace(measurement, problem=problem))
        window.verdict.show_verdict(problem, is_failed=False, is_busy=False, mask_note="")
        settle()
        places.append(window.menu_bar.geometry())
        assert window.recording_panel.text.geometry().right() < window.recording_panel.keep.geometry().left()
        assert problem in window.verdict.text()
        assert not window.verdict.text().endswith(ELLIPSIS)
        assert not cut_texts(window.menu_bar.parentWidget() or window)
    assert len(set(map(str, places))) == 1


def test_text_takes_a_second_line_and_then_an_ellipsis(qtbot: QtBot) -> None:
    made = ElidedLabel(lines=2)
    qtbot.addWidget(made)
    made.resize(120, 20)
    made.show()
    made.setText("short")
    line = made.minimumHeight()
    assert made.shown == "short"
    made.setText("one layer in front of the lenslets")
    assert made.shown.replace("\n", "").rstrip() == "one layer in front of the lenslets"
    assert made.minimumHeight() == 2 * line
    made.setText("one layer in front of the lenslets: some of the displacements are unexplained")
    assert made.shown.count("\n") == 1
    assert made.shown.endswith("\N{HORIZONTAL ELLIPSIS}")
    made.setText("short")
    assert made.minimumHeight() == 2 * line  # nothing jumps


def test_text_is_cut_after_a_word_and_no_line_begins_with_a_unit(qtbot: QtBot) -> None:
    made = ElidedLabel(lines=2)
    qtbot.addWidget(made)
    made.show()
    words = ["the", "dark", "was", "taken", "at", "27.8", "ms:", "take", "it", "again,", "then", "the", "reference"]
    for width in range(110, 400):
        made.resize(width, 40)
        made.setText(" ".join(words))
        assert "\nms" not in made.shown
        shown = made.shown.replace("\n", " ").removesuffix(ELLIPSIS).split()
        assert [each.rstrip(":,") for each in shown] == [each.rstrip(":,") for each in words[: len(shown)]]
    made.resize(150, 40)
    made.setText("20261129-101500-a_name_without_a_space_that_is_long")  # cut anywhere rather than missing
    assert made.shown.startswith("20261129")


def test_time_of_a_recording_is_red(qtbot: QtBot) -> None:
    panel = RecordingPanel()
    qtbot.addWidget(panel)
    panel.setStyleSheet(theme._style())
    panel.show()
    for state, colour in ((None, theme.DIM), (RecordingState(Path("run"), "recording", 9, 0, 1.0, ""), theme.RED)):
        panel.show_state(state)
        assert panel.text.palette().color(panel.text.foregroundRole()).name() == colour.name()


def test_disk_space_gives_way_to_what_happens_in_the_recording(qtbot: QtBot) -> None:
    panel = RecordingPanel()
    qtbot.addWidget(panel)
    state = RecordingState(Path("run"), "recording", 123456, 1234, 3600.0, "")
    panel.show_state(state, 58.0)
    assert panel.text.text() == "REC 60:00   123456   1234 waiting for the disk"
    assert "58 min" in panel.text.toolTip()
    panel.show_state(None, 58.0)
    assert panel.text.text() == "disk space for 58 min"


def test_recording_bar_leaves_the_controls_in_place(make_window: MakeWindow) -> None:
    window = make_window()
    window.resize(1280, 800)
    settle()
    before = window.controls.mapTo(window, QPoint())
    window.recording_bar.prepare()
    settle()
    assert window.recording_bar.isVisible()
    assert window.controls.mapTo(window, QPoint()) == before


@pytest.mark.usefixtures("restored_theme")
def test_controls_need_no_scroll_bar_on_a_small_screen_while_frames_are_recorded(make_window: MakeWindow) -> None:
    styled_application()
    window = make_window()
    window.resize(1270, 680)  # of 1280 x 720, without the frame of a window manager
    window.docks.restore_default()
    window.controls.method.setText("Method: Gauss-Newton, quartic, 190 modes")
    window.recording_bar.prepare()
    settle()
    area = window.controls.findChild(QScrollArea)
    assert area is not None
    bar = area.verticalScrollBar()
    assert bar is not None
    assert not bar.isVisible()
