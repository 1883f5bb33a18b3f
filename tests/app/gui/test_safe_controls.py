"""Safe controls: typed numbers, keys and wheel reach a device only as intended, and the light goes off at once."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from PyQt6.QtCore import QPoint, QPointF, Qt
from PyQt6.QtGui import QImage, QWheelEvent
from PyQt6.QtWidgets import QApplication, QWidget
from pytestqt.qtbot import QtBot
from support.gui_bench import FakeCamera
from support.patience import HANG_S
from support.window_tools import part, picture, press
from test_number_field import type_text

from app.acquisition.instrument import Commands
from app.gui.shell.main_window import MainWindow
from app.gui.shell.status_text import warning
from app.gui.widgets import theme
from app.results.view_maps import Quantity
from drivers.interface import Range


def scroll(widget: QWidget) -> None:
    middle = QPointF(widget.rect().center())
    nothing, step = QPoint(), QPoint(0, 120)
    event = QWheelEvent(
        middle,
        widget.mapToGlobal(middle),
        nothing,
        step,
        Qt.MouseButton.NoButton,
        Qt.KeyboardModifier.NoModifier,
        Qt.ScrollPhase.NoScrollPhase,
        False,
    )
    QApplication.sendEvent(widget, event)


def says(window: MainWindow, text: str) -> bool:
    return window.messages.text.text() == text


@pytest.mark.slow
@pytest.mark.long
def test_refused_number_is_explained_in_red_and_reaches_no_device(
    live: tuple[MainWindow, FakeCamera], qtbot: QtBot
) -> None:
    window, camera = live
    window.activateWindow()
    field = window.controls.current
    press(qtbot, window, Qt.Key.Key_C)
    qtbot.waitUntil(field.hasFocus)
    type_text(qtbot, field, "9999")
    press(qtbot, field, Qt.Key.Key_Return)
    window.update_text()
    text = window.messages.text
    assert text.text() == "Current 9999 is outside the allowed range 0 ... 1000 mA: not changed"
    assert text.property("tone") == theme.tone(theme.RED)
    press(qtbot, field, Qt.Key.Key_Escape)
    window.controls.frames.edit()
    qtbot.waitUntil(window.controls.frames.hasFocus)
    type_text(qtbot, window.controls.frames, "20000")
    window.controls.dark.click()  # does not take the focus
    assert camera.light.current_a == 0.35
    assert window.controller.is_settled


def test_typed_letters_and_space_are_no_shortcuts(live: tuple[MainWindow, FakeCamera], qtbot: QtBot) -> None:
    window, camera = live
    window.activateWindow()
    press(qtbot, window, Qt.Key.Key_E)
    qtbot.waitUntil(window.controls.exposure.hasFocus)
    type_text(qtbot, window.controls.exposure, "40 ms")
    assert camera.is_running
    assert camera.stage.is_sample_in
    assert window.controller.is_settled
    press(qtbot, window.controls.exposure, Qt.Key.Key_Return)
    qtbot.waitUntil(lambda: camera.exposure_s == 0.04)
    assert camera.is_running


def test_escape_leaves_an_unchanged_field_and_digits_choose_the_view(
    live: tuple[MainWindow, FakeCamera], qtbot: QtBot
) -> None:
    window, camera = live
    window.activateWindow()
    press(qtbot, window, Qt.Key.Key_E)
    qtbot.waitUntil(window.controls.exposure.hasFocus)
    press(qtbot, window.controls.exposure, Qt.Key.Key_Escape)
    assert not window.controls.exposure.hasFocus()
    press(qtbot, window, Qt.Key.Key_2)
    assert window.panels.wavefronts.quantity is tuple(Quantity)[1]
    assert camera.exposure_s == 0.02


def test_status_does_not_replace_what_is_being_typed(live: tuple[MainWindow, FakeCamera], qtbot: QtBot) -> None:
    window, _ = live
    window.activateWindow()
    field = window.controls.exposure
    press(qtbot, window, Qt.Key.Key_E)
    qtbot.waitUntil(field.hasFocus)
    type_text(qtbot, field, "4")
    field.show_value(0.03, Range(0.01, 10))  # for example after an automatic exposure
    assert field.text() == "4"
    press(qtbot, field, Qt.Key.Key_Escape)
    assert field.text() == "30.000"


def test_wheel_changes_a_field_or_choice_only_with_focus(live: tuple[MainWindow, FakeCamera], qtbot: QtBot) -> None:
    window, camera = live
    window.activateWindow()
    controls = window.controls
    requests: list[tuple[object, ...]] = []
    for signal in (controls.requested, controls.wanted):
        signal.connect(lambda *request: requests.append(request))
    for widget in (controls.exposure, controls.choices["mask"]):
        scroll(widget)
    assert controls.exposure.value() == 20
    assert not requests
    assert controls.choices["mask"].currentText() == "square"
    controls.exposure.setFocus()
    qtbot.waitUntil(controls.exposure.hasFocus)
    scroll(controls.exposure)
    qtbot.waitUntil(lambda: camera.exposure_s > 0.02)


@pytest.mark.parametrize("key", [Qt.Key.Key_Space, Qt.Key.Key_Return])
def test_key_operates_the_focused_button_alone(live: tuple[MainWindow, FakeCamera], qtbot: QtBot, key: Qt.Key) -> None:
    window, camera = live
    window.activateWindow()
    window.controls.light.setFocus()
    qtbot.waitUntil(window.controls.light.hasFocus)
    press(qtbot, window.controls.light, key)
    qtbot.waitUntil(lambda: not camera.light.shines)
    assert camera.is_running


@pytest.mark.parametrize(("routine", "shown"), [("dark", "Light off"), ("reference", "Sample out")])
def test_indicators_show_the_state_during_a_routine(
    live: tuple[MainWindow, FakeCamera], qtbot: QtBot, routine: str, shown: str
) -> None:
    window, camera = live
    controls = window.controls
    controls.frames.setValue(1000)
    indicator = controls.light if routine == "dark" else controls.sample
    getattr(controls, routine).click()
    progress = window.messages.progress
    qtbot.waitUntil(lambda: indicator.text() == shown and not indicator.isChecked() and progress.isVisible())
    assert camera.light.shines == (routine == "reference")
    press(qtbot, window, Qt.Key.Key_Escape)
    qtbot.waitUntil(lambda: controls.light.text() == "Light on" and controls.sample.text() == "Sample in")


@pytest.mark.slow
@pytest.mark.long
def test_message_names_the_actual_cause(live: tuple[MainWindow, FakeCamera], qtbot: QtBot) -> None:
    """A frame that does not match is not blamed on the light if the light is on, nor the reverse."""
    window, _ = live
    status = window._status
    assert status is not None
    doubtful = replace(status.reference, doubt="it is stale")
    unmatched = "no lenslet of the frame could be matched with the reference: is the light on?"
    for changes, text in (
        ({"is_light_on": False}, "the light is off: switch it on (L)"),
        ({"is_light_on": False, "reference": doubtful, "warning": "it is stale"}, "the light is off: switch it on (L)"),
        (
            {"reference": doubtful, "warning": "it was taken with the mask stars"},
            "it was taken with the mask stars  (R",
        ),
        ({}, unmatched),
    ):
        assert warning(replace(status, **changes), unmatched).startswith(text)
    window.controls.wanted.emit("mask", "stars")
    qtbot.waitUntil(lambda: "taken with the mask square" in window.messages.text.text())


def test_amplifier_change_says_what_else_it_changed(
    live: tuple[MainWindow, FakeCamera], qtbot: QtBot, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("app.measurement.routines._MARGIN_S", HANG_S)  # no frame comes after 421 ms
    window, camera = live
    choose = camera._set_amplifier

    def set_amplifier(amplifier: str) -> None:
        choose(amplifier)
        if amplifier == "normal":
            camera._exposure, camera._gain = 0.421, 1.0

    camera._set_amplifier = set_amplifier  # type: ignore[method-assign] # as a camera with slower readout
    window.controls.em_gain.setValue(7)
    for amplifier, text, state in (
        ("normal", "Exposure changed from 20 to 421 ms, gain changed from 7 to 1", (0.421, 1.0)),
        ("em", "Exposure changed from 421 to 20 ms, gain changed from 1 to 7", (0.02, 7.0)),
    ):
        window.controls.wanted.emit(Commands.set_amplifier, amplifier)
        qtbot.waitUntil(partial(says, window, text))
        assert (camera.exposure_s, camera.em_gain) == state


@pytest.mark.slow
@pytest.mark.long
def test_stale_calibration_greys_the_wavefronts_and_says_why(live: tuple[MainWindow, FakeCamera], qtbot: QtBot) -> None:
    window, camera = live
    panel, controls = window.panels.wavefronts, window.controls

    def colourfulness() -> int:
        seen = picture(panel.grid).astype(int)
        tile = part(seen, panel.grid.places.tile(0, 0).adjusted(3, 3, -3, -3))
        return int(np.ptp(tile, axis=-1).max())

    def lamp() -> bytes:
        image = controls.reference.icon().pixmap(32, 32).toImage().convertToFormat(QImage.Format.Format_Alpha8)
        return bytes(image.constBits().asarray(image.sizeInBytes()))

    assert colourfulness() > 50
    good = lamp()
    assert "Good: 6 frames at" in controls.reference.toolTip()
    assert "exposure 20 ms" in controls.reference.toolTip()
    controls.exposure.setValue(30)
    qtbot.waitUntil(lambda: camera.exposure_s == 0.03 and "STALE" in panel._summary.text())
    assert "STALE: the dark was taken at 20.0 ms" in panel._summary.text()
    assert colourfulness() < 10  # a trace of the background
    assert lamp() != good  # another shape, whatever its colour
    assert "the reference was taken at 20.0 ms" in controls.reference.toolTip()
    controls.exposure.setValue(20)
    qtbot.waitUntil(lambda: "STALE" not in panel._summary.text())
    assert colourfulness() > 50
