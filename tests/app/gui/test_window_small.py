"""Small windows and large fonts: the important texts stay whole and nothing overlaps."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from PyQt6.QtCore import QPoint, QRect, Qt
from PyQt6.QtGui import QFont
from PyQt6.QtWidgets import (
    QApplication,
    QComboBox,
    QLabel,
    QLineEdit,
    QPushButton,
    QStyle,
    QStyleOptionButton,
    QStyleOptionComboBox,
    QWidget,
)
from pytestqt.qtbot import QtBot
from support.gui_bench import FakeCamera, make_measurement
from support.window_tools import MakeWindow, dim_frame, press, views, wait_for_wavefront

from app.acquisition.running_instrument import Activity
from app.gui.shell.help import TextDialog
from app.gui.shell.main_window import MainWindow
from app.gui.shell.status_line import StatusLine
from app.gui.shell.wording import advice
from app.gui.widgets.fields import NumberField
from app.gui.widgets.theme import apply_theme
from app.measurement.measurement import Assumptions, FrameTotals, RefinementState
from reconstruction.layers.layered_wavefront import FREE, AssumedSample

LONG = "the recording ended early, 1203 frames are saved: the disk is full, free some space and start another recording"

LAYER = AssumedSample((-0.975,), np.array([[0.005**2]]))


@pytest.fixture
def large_font(qapp: QApplication) -> Iterator[None]:
    """Enlarge the application's font by half during a test."""
    usual = QFont(qapp.font())
    font = QFont(usual)
    font.setPointSizeF(1.5 * usual.pointSizeF())
    qapp.setFont(font)
    yield
    qapp.setFont(usual)


def fill(window: MainWindow) -> None:
    """Show the large numbers of a long run and a long alarm."""
    measurement = make_measurement(dim_frame(), views())
    refinement = RefinementState(stage="applied", age_s=12.3)
    many = replace(
        measurement,
        counts=FrameTotals(1234567, 1204567, 30123),
        latency_s=0.9876,
        assumed=Assumptions(refinement=refinement),
    )
    window.messages.alarm(LONG)
    window.status_line.times.show()
    window.show_measurement(many)
    window.status_line.devices.setText("running")
    window.update_text()
    for _ in range(3):  # one layout triggers others
        QApplication.processEvents()


def place(widget: QWidget, window: QWidget) -> QRect:
    return QRect(widget.mapTo(window, QPoint()), widget.size())


def assert_nothing_overlaps(window: MainWindow) -> None:
    """Neither panels nor texts lie over each other or reach beyond the window."""
    panels: list[QWidget] = [window.panels.camera, window.panels.quality, window.panels.wavefronts, window.messages]
    panels.append(window.controls)
    panels += [window.status_line, window.recording_panel]
    texts = [text for text in window.findChildren(QLabel) if text.isVisible()]
    rest: list[QWidget] = [*texts, window.panels.camera._graphics, window.panels.wavefronts.grid]
    for group in (panels, rest):
        for one, other in combinations(group, 2):
            if one.isVisible() and other.isVisible() and not (one.isAncestorOf(other) or other.isAncestorOf(one)):
                assert not place(one, window).intersects(place(other, window)), (one, other)
        assert all(window.rect().contains(place(one, window)) for one in group if one.isVisible())


@pytest.mark.parametrize("size", [(904, 600), (1024, 640), (1280, 800), (1920, 1080)])
def test_long_texts_fit_at_every_size(make_window: MakeWindow, size: tuple[int, int]) -> None:
    window = make_window()
    window.resize(*size)
    fill(window)
    assert (window.width(), window.height()) == size
    assert_nothing_overlaps(window)
    assert window.messages.text.toolTip() == LONG.capitalize()
    line = window.status_line
    for value in (line.rate, line.delay, line.lost, line.valid, line.correction):
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


def cut_texts(window: MainWindow) -> list[str]:
    """Texts of the controls that are wider than their room, in the smallest window."""
    window.resize(1, 1)
    for _ in range(3):  # one layout triggers others
        QApplication.processEvents()
    texts = [(text_of(one), one) for one in window.controls.findChildren(QWidget) if text_of(one)]
    assert len(texts) > 25
    return [text for text, one in texts if room(one) < one.fontMetrics().horizontalAdvance(text)]


@pytest.mark.slow
@pytest.mark.usefixtures("restored_theme")
@pytest.mark.parametrize("font", ["usual", "large"])
def test_no_text_in_the_controls_is_cut(
    make_window: MakeWindow, qtbot: QtBot, qapp: QApplication, request: pytest.FixtureRequest, font: str
) -> None:
    if font == "large":
        request.getfixturevalue("large_font")
    apply_theme(qapp)
    window = make_window(FakeCamera())
    window.connect_devices()
    wait_for_wavefront(qtbot, window)
    assert cut_texts(window) == []
    assert (window.width() == 900) == (font == "usual")
    status = window.controller.status
    assert status is not None
    registration = replace(status.bench.registration, method="correlation_fft", warp="translation")
    window._timer.stop()  # the next is no state of the instrument
    longest = replace(status, bench=replace(status.bench, registration=registration), amplifier="normal", mask="stars")
    window.controls.show_status(longest)
    assert cut_texts(window) == []


@pytest.mark.usefixtures("large_font")
def test_larger_font_widens_the_window(make_window: MakeWindow) -> None:
    window = make_window()
    window.resize(904, 600)  # wide enough for the usual font
    fill(window)
    assert window.width() > 904
    assert_nothing_overlaps(window)


def test_numbers_keep_their_room_and_the_rest_is_told_in_a_tooltip(qtbot: QtBot) -> None:
    line = StatusLine()
    qtbot.addWidget(line)
    line.resize(880, 40)
    line.show()
    many = replace(make_measurement(dim_frame(), views()), counts=FrameTotals(1234567, 1204567, 30123))
    line.count(many)
    line.update_text(None, None)
    wide = line.lost.width()
    assert wide >= line.lost.fontMetrics().horizontalAdvance("30123")
    assert "1234567 acquired, 1204567 reconstructed, 1 shown" in line.rate.toolTip()
    line.count(replace(many, counts=FrameTotals(1234568, 1204568, 30124), latency_s=0.9))
    line.update_text(None, None)
    assert line.lost.property("tone") == "red"  # it has grown
    line.restart()
    line.count(replace(many, counts=FrameTotals(1, 1, 1)))
    line.update_text(None, None)
    assert line.lost.width() == wide
    assert line.lost.property("tone") == "text"


def test_times_are_told_in_milliseconds_and_seconds(qtbot: QtBot) -> None:
    for seconds, text in ((0.0123, "12.3 ms"), (4.56, "4.6 s")):
        line = StatusLine()
        qtbot.addWidget(line)
        line.count(replace(make_measurement(dim_frame(), views()), latency_s=seconds))
        line.update_text(None, None)
        assert text in {value.text() for value in line.findChildren(QLabel)}


@pytest.mark.usefixtures("large_font")
def test_help_fits_on_the_screen_and_scrolls(make_window: MakeWindow) -> None:
    window = make_window()
    open_help(window)
    (dialog,) = window.findChildren(QWidget, "help")
    screen = window.screen()
    assert screen is not None
    assert dialog.height() <= screen.availableGeometry().height()
    assert isinstance(dialog, TextDialog)
    bar, document, viewport = dialog.view.horizontalScrollBar(), dialog.view.document(), dialog.view.viewport()
    assert bar is not None
    assert document is not None
    assert viewport is not None
    assert bar.maximum() >= document.size().width() - viewport.width() - 1  # nothing is cut off
    for words in ("Take a dark", "Edit the exposure", "Uncertainty over the field"):
        assert words in dialog.view.toPlainText().replace("\N{NO-BREAK SPACE}", " ")
    dialog.close()


def open_help(window: MainWindow) -> None:
    bar = window.menuBar()
    assert bar is not None
    menu = bar.actions()[-1].menu()
    assert menu is not None
    menu.actions()[0].trigger()


def test_tab_visits_the_controls_in_order(make_window: MakeWindow) -> None:
    window = make_window()
    window.controls.setEnabled(True)
    stops: list[QWidget] = []
    widget = window.nextInFocusChain()
    while widget is not None and widget not in stops:
        stops.append(widget)
        widget = widget.nextInFocusChain()
    keyed = [stop for stop in stops if stop.focusPolicy() & Qt.FocusPolicy.TabFocus and stop.isVisible()]
    controls = window.controls
    wanted: list[QWidget] = [window.panels.camera.lattice_toggle, window.panels.wavefronts.freeze_scale]
    wanted += [controls.light, controls.start, controls.dark, controls.refine, window.recording_panel.record]
    places = [keyed.index(each) for each in wanted]
    assert places == sorted(places)  # from left to right, from the top down
    assert not any("Graphics" in type(stop).__name__ for stop in keyed)
    for stop in keyed:
        assert stop is window.panels.wavefronts.grid or stop.toolTip() or isinstance(stop.parent(), NumberField), stop


def test_escape_closes_only_the_help(make_window: MakeWindow, qtbot: QtBot) -> None:
    window = make_window()
    open_help(window)
    (dialog,) = window.findChildren(QWidget, "help")
    press(qtbot, dialog, Qt.Key.Key_Escape)
    assert not dialog.isVisible()
    assert window.isVisible()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sample", "told"),
    [
        (None, "any wavefront (searching for layers)"),
        (FREE, "any wavefront"),
        (
            AssumedSample((-0.975,), np.array([[0.005**2]])),
            "one layer 195 \N{PLUS-MINUS SIGN} 1 mm in front of the lenslets",
        ),
    ],
)
def test_sample_and_mask_are_told_in_the_window(
    live: tuple[MainWindow, FakeCamera], sample: AssumedSample | None, told: str
) -> None:
    window, line, note = live[0], live[0].status_line, "the mask shows 7 of 9 deformations"
    assert window._status is not None
    line.count(replace(make_measurement(dim_frame(), views()), assumed=Assumptions(sample)))
    window._status = status = replace(window._status, mask_note=note)
    line.update_text(status, None)
    assert line.assumed.text() == f"Sample: {told}"
    assert line.assumed.isVisible()
    assert advice(status, Activity(), window.shown.measurement) == note  # while there is nothing to do
    assert not line._of_correction.isVisible()


@pytest.mark.slow
@pytest.mark.long
def test_window_with_recording_bar_fits_a_full_hd_screen_at_scale_2(make_window: MakeWindow, qtbot: QtBot) -> None:
    window = make_window(FakeCamera())
    window.connect_devices()
    wait_for_wavefront(qtbot, window)
    for chart in window.panels.history.toggles.values():
        chart.setChecked(True)
    window.docks.show_panel(window.panels.history)
    window.recording_bar.prepare()
    for _ in range(2):  # a low window has another layout
        cut_texts(window)  # makes it as small as it can be
    assert window.width() <= 960
    assert window.height() <= 1080 / 2 - 40  # 40 px for the frame of a window manager


def test_recording_bar_leaves_the_controls_in_place(make_window: MakeWindow) -> None:
    window = make_window()
    window.resize(1280, 800)
    QApplication.processEvents()
    before = place(window.controls, window)
    window.recording_bar.prepare()
    for _ in range(3):  # one layout triggers others
        QApplication.processEvents()
    assert window.recording_bar.isVisible()
    assert place(window.controls, window) == before
    assert place(window.recording_bar, window).bottom() < before.top()
