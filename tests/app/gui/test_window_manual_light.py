"""Manual light in the window: it asks the person, and never claims that the light is off."""

from __future__ import annotations

from dataclasses import replace

import pytest
from PyQt6.QtCore import Qt
from PyQt6.QtGui import QCloseEvent
from PyQt6.QtWidgets import QApplication
from pytestqt.qtbot import QtBot
from support.gui_bench import FakeCamera, opener
from support.manual_bench import MANUAL
from support.window_tools import MakeWindow, press

from app.acquisition.worker import Acquisition
from app.gui.shell.main_window import MainWindow
from app.results.player import InstrumentFactory
from drivers.interface import Devices, Disconnected
from drivers.light_source import ManualLight, ManualLightSettings

BENCH = replace(MANUAL, light=ManualLightSettings())


@pytest.fixture
def by_hand(make_window: MakeWindow, qtbot: QtBot) -> tuple[MainWindow, ManualLight]:
    """A window on a bench without motors whose light is switched by hand; nobody has said anything yet."""
    camera, light = FakeCamera(), ManualLight()
    camera.light = light  # type: ignore[assignment] # the camera sees whether it is on
    window = make_window()
    window.open(InstrumentFactory(lambda: Acquisition(BENCH, opener(camera))))
    qtbot.waitUntil(lambda: window.controls.light.text() == "Light by hand")
    qtbot.waitUntil(lambda: camera.is_running and window.controller.is_settled)
    window.activateWindow()
    return window, light


def says(window: MainWindow, text: str) -> bool:
    window.update_text()
    return window.messages.text.text() == text


@pytest.mark.slow
def test_dark_and_reference_ask_for_the_light(by_hand: tuple[MainWindow, ManualLight], qtbot: QtBot) -> None:
    window, light = by_hand
    assert window._status is not None
    assert window._status.dark.validity == "missing"  # the start could not take it
    assert not window.controls.current.isEnabled()
    press(qtbot, window, Qt.Key.Key_D)
    assert says(window, "Switch the light off by hand")
    assert light.is_on
    window.messages.accept.click()
    qtbot.waitUntil(lambda: says(window, "Switch the light on by hand"))  # after the dark
    assert not light.is_on
    assert window.controls.light.text() == "Light noted off"
    qtbot.waitUntil(lambda: window._status is not None and window._status.dark.validity == "good")
    window.messages.discard.click()
    assert not light.is_on
    press(qtbot, window, Qt.Key.Key_R)
    assert says(window, "Switch the light on by hand")
    press(qtbot, window, Qt.Key.Key_Return)
    qtbot.waitUntil(lambda: window._status is not None and window._status.reference.validity == "good")
    assert light.is_on
    assert window.controls.light.text() == "Light by hand"


def test_button_notes_only_what_was_confirmed(by_hand: tuple[MainWindow, ManualLight], qtbot: QtBot) -> None:
    window, light = by_hand
    window.controls.light.click()
    assert window.controls.light.text() == "Light by hand"
    assert window.controls.light.isChecked()
    window.messages.discard.click()
    assert light.is_on
    window.controls.light.click()
    window.messages.accept.click()
    qtbot.waitUntil(lambda: not light.is_on)


def test_user_is_asked_before_the_window_closes(by_hand: tuple[MainWindow, ManualLight], qtbot: QtBot) -> None:
    window, light = by_hand
    for quits in (window.quit, lambda: close_by_user(window)):
        quits()
        assert window.isVisible()
        assert says(window, "Switch the light off by hand")
        window.messages.discard.click()
    window.quit()
    window.messages.accept.click()
    qtbot.waitUntil(lambda: not window.isVisible())
    assert not light._is_noted_on


def close_by_user(window: MainWindow) -> None:
    QApplication.sendEvent(window.windowHandle(), QCloseEvent())
    QApplication.processEvents()


def test_devices_that_do_not_open_tell_nothing_of_the_light(make_window: MakeWindow, qtbot: QtBot) -> None:
    def fail(*_: object) -> Devices:
        raise Disconnected("there is no camera")

    window = make_window()
    window.open(InstrumentFactory(lambda: Acquisition(BENCH, fail)))
    text = "There is no camera  \N{EM DASH}  no device is open: reconnect (Ctrl+R)"
    qtbot.waitUntil(lambda: window.messages.text.text() == text)
    assert window.messages.reconnect.isVisible()
