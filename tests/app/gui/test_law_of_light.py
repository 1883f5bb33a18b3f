"""A request to switch the light off wins over every sequence of commands, dialogs and benches."""

from __future__ import annotations

import threading
from collections.abc import Callable

import pytest
from PyQt6.QtCore import Qt
from PyQt6.QtGui import QAction
from PyQt6.QtWidgets import QApplication, QDialog, QWidget
from pytestqt.qtbot import QtBot
from support.gui_bench import BENCH, FakeCamera, opener
from support.patience import HANG_S
from support.window_tools import MakeWindow, click, press, wait_for_wavefront
from test_calibration_guide import ExposedCamera
from test_window_small import open_help

from app.acquisition.worker import Acquisition
from app.bench.config import Bench
from app.gui.shell.access import Access
from app.gui.shell.main_window import MainWindow
from drivers.interface import Devices, Disconnected


def focused(window: QWidget) -> QWidget:
    """Where a key goes that is pressed now."""
    return QApplication.focusWidget() or window


def activate(window: QWidget, qtbot: QtBot) -> None:
    window.activateWindow()
    qtbot.waitUntil(window.isActiveWindow)


@pytest.mark.slow
@pytest.mark.usefixtures("no_rest")
def test_light_off_between_two_steps_ends_the_guided_calibration(make_window: MakeWindow, qtbot: QtBot) -> None:
    camera = ExposedCamera()
    window = make_window(camera)
    window.connect_devices()
    wait_for_wavefront(qtbot, window)
    guide = window.guide
    window._timer.stop()  # no answer is seen yet
    window.controls.calibrate.click()
    qtbot.waitUntil(window.controller._pending[-1][0].done)
    window.controls.light.click()
    qtbot.waitUntil(lambda: not camera.light.shines)
    window._timer.start()
    qtbot.waitUntil(lambda: window.controller.is_settled and not window.light.is_switching_off)
    assert guide.question.text() == "Ended: the light was switched off"
    assert not camera.light.shines
    press(qtbot, guide, Qt.Key.Key_Escape)
    qtbot.waitUntil(lambda: window.controls.light.text() == "Light off")
    activate(window, qtbot)
    press(qtbot, window, Qt.Key.Key_L)
    qtbot.waitUntil(lambda: camera.light.shines)


def test_light_key_during_a_dark_keeps_the_light_off(live: tuple[MainWindow, FakeCamera], qtbot: QtBot) -> None:
    window, camera = live
    window.controls.frames.setValue(1000)
    window.controls.dark.click()
    qtbot.waitUntil(lambda: window.controls.light.text() == "Light off")
    activate(window, qtbot)
    press(qtbot, window, Qt.Key.Key_L)
    qtbot.waitUntil(lambda: window.controller.is_settled and not window.light.is_switching_off)
    assert not camera.light.shines
    assert camera.is_running


def enlarged(window: MainWindow) -> None:
    window.panels.wavefronts.enlarge()


DIALOGS: dict[str, Callable[[MainWindow], object]] = {
    "guide": lambda window: window.guide.show(),
    "region": lambda window: window.region_dialog.show(),
    "settings": lambda window: window.benches.edit(),
    "fault": lambda window: window.benches.dialog.show_message("Faulty bench", "It is faulty", ()),
    "enlarged": enlarged,
    "help": open_help,
}


@pytest.mark.slow
@pytest.mark.usefixtures("no_rest")
def test_light_key_works_in_every_dialog(live: tuple[MainWindow, FakeCamera], qtbot: QtBot) -> None:
    window, camera = live
    activate(window, qtbot)
    for name, opens in DIALOGS.items():
        before = camera.light.shines
        opens(window)
        dialog = next(one for one in window.findChildren(QDialog) if one.isVisible())
        activate(dialog, qtbot)
        press(qtbot, focused(dialog), Qt.Key.Key_L)
        qtbot.waitUntil(lambda before=before: camera.light.shines != before)  # type: ignore[misc] # mypy and defaults
        qtbot.waitUntil(lambda before=before: window.controls.light.text() == f"Light {'off' if before else 'on'}")  # type: ignore[misc] # mypy and defaults
        dialog.close()
        activate(window, qtbot)
        assert focused(window) is window, name


def test_held_key_switches_once(live: tuple[MainWindow, FakeCamera]) -> None:
    window, _ = live
    actions = [action for action in window.findChildren(QAction) if not action.shortcut().isEmpty()]
    assert "L" in {action.shortcut().toString() for action in actions}
    assert not [action.text() for action in actions if action.autoRepeat()]


@pytest.mark.slow
def test_second_light_key_keeps_off_what_is_lighting_up(live: tuple[MainWindow, FakeCamera], qtbot: QtBot) -> None:
    """Although a change of the status between both shows the light as off again."""
    window, camera = live
    activate(window, qtbot)
    press(qtbot, window, Qt.Key.Key_L)
    qtbot.waitUntil(lambda: window.controls.light.text() == "Light off" and window.controller.is_settled)
    busy = threading.Event()
    acquisition = window.controller.acquisition
    assert acquisition is not None
    acquisition.submit(lambda _: busy.wait(HANG_S))
    for _ in range(2):
        press(qtbot, window, Qt.Key.Key_L)
        window.controls.light.setChecked(False)
    busy.set()
    qtbot.waitUntil(lambda: window.controller.is_settled and not window.light.is_switching_off)
    assert not camera.light.shines
    assert "light stays off" in window.messages.log


def test_light_key_at_start_keeps_the_light_off(
    make_window: MakeWindow, qtbot: QtBot, monkeypatch: pytest.MonkeyPatch
) -> None:
    camera = FakeCamera()
    window, switch, lighting, go = make_window(camera), camera.light._switch, threading.Event(), threading.Event()

    def switch_slowly(*, on: bool) -> None:
        if on:
            lighting.set()
            go.wait(HANG_S)
        switch(on=on)

    monkeypatch.setattr(camera.light, "_switch", switch_slowly)
    window.connect_devices()
    activate(window, qtbot)
    qtbot.waitUntil(lambda: lighting.is_set() and window.controls.isEnabled())
    press(qtbot, window, Qt.Key.Key_L)
    go.set()
    qtbot.waitUntil(lambda: window.controller.is_settled and not window.light.is_switching_off)
    assert not camera.light.shines


def switch_off(window: MainWindow, qtbot: QtBot) -> None:
    activate(window, qtbot)
    press(qtbot, window, Qt.Key.Key_L)
    qtbot.waitUntil(lambda: window.controls.light.text() == "Light off" and window.controller.is_settled)


@pytest.mark.slow
@pytest.mark.parametrize("by", ["key", "button"])
def test_light_that_was_just_switched_off_is_not_switched_on(
    live: tuple[MainWindow, FakeCamera], qtbot: QtBot, monkeypatch: pytest.MonkeyPatch, by: str
) -> None:
    """Neither by a second press, nor by a key that is held, which some remote desktops send as many presses."""
    window, camera = live
    monkeypatch.setattr("app.gui.shell.light_control._REST_S", 3.0)  # for a slow computer

    def press_again() -> None:
        if by == "key":
            press(qtbot, window, Qt.Key.Key_L)
        else:
            click(qtbot, window.controls.light, window.controls.light.rect().center())

    switch_off(window, qtbot)
    for _ in range(8):  # longer than the rest
        press_again()
        qtbot.wait(500)
        assert not camera.light.shines
    assert "  The light stays off: it was switched off within the last second; L switches it on" in window.messages.log
    qtbot.waitUntil(lambda: window.controller.is_settled and not window.light.is_switching_off)
    assert not window.controls.light.isChecked()
    qtbot.wait(3000)
    press_again()
    qtbot.waitUntil(lambda: camera.light.shines)


@pytest.mark.slow
@pytest.mark.parametrize("is_late", [False, True])
def test_reconnecting_leaves_the_light_off(make_window: MakeWindow, qtbot: QtBot, *, is_late: bool) -> None:
    """Also if it was switched off after the camera had failed."""
    first, second = FakeCamera(), FakeCamera()
    lit: list[bool] = []
    second.light._switch = lambda *, on: lit.append(on)  # type: ignore[method-assign] # watched
    window = make_window(first, second)
    window.connect_devices()
    wait_for_wavefront(qtbot, window)
    if not is_late:
        switch_off(window, qtbot)
    first.fault = Disconnected("the camera was unplugged")
    qtbot.waitUntil(window.messages.reconnect.isVisible)
    if is_late:
        press(qtbot, window, Qt.Key.Key_L)
    window.messages.reconnect.click()
    qtbot.waitUntil(lambda: second.is_running and window.controller.is_settled)
    assert second.stage.is_sample_in
    assert window.controller.status is not None
    assert window.controller.status.dark.validity == "good"
    assert True not in lit
    assert "  The light stays off, as you left it: L switches it on" in window.messages.log


@pytest.mark.slow
def test_opening_a_bench_leaves_the_light_off(make_window: MakeWindow, qtbot: QtBot) -> None:
    first, second = FakeCamera(), FakeCamera()
    lit: list[bool] = []
    second.light._switch = lambda *, on: lit.append(on)  # type: ignore[method-assign] # watched
    window = make_window(first)
    window.connect_devices()
    wait_for_wavefront(qtbot, window)
    switch_off(window, qtbot)
    window.open(Access(lambda: Acquisition(BENCH, opener(second))))
    qtbot.waitUntil(lambda: second.is_running and window.controller.is_settled)
    assert True not in lit
    assert "  The light stays off, as you left it: L switches it on" in window.messages.log


@pytest.mark.slow
def test_space_stops_the_camera_although_nothing_was_clicked(live: tuple[MainWindow, FakeCamera], qtbot: QtBot) -> None:
    window, camera = live
    window.activateWindow()
    activate(window, qtbot)
    press(qtbot, focused(window), Qt.Key.Key_Space)
    qtbot.waitUntil(lambda: not camera.is_running)
    assert window.panels.camera.lattice_toggle.isChecked()
    press(qtbot, focused(window), Qt.Key.Key_N)
    qtbot.waitUntil(window.messages.accept.isVisible)
    press(qtbot, focused(window), Qt.Key.Key_Return)
    qtbot.waitUntil(lambda: "lattice is in use" in window.messages.log)


@pytest.mark.slow
def test_light_key_keeps_the_light_off_while_a_bench_opens(
    live: tuple[MainWindow, FakeCamera], qtbot: QtBot, monkeypatch: pytest.MonkeyPatch
) -> None:
    window, _ = live
    activate(window, qtbot)
    camera, release = FakeCamera(), threading.Event()
    lit: list[bool] = []
    monkeypatch.setattr(camera.light, "_switch", lambda *, on: lit.append(on))

    def open_slowly(bench: Bench, progress: Callable[[float], None]) -> Devices:
        release.wait(HANG_S)
        return opener(camera)(bench, progress)

    window.open(Access(lambda: Acquisition(BENCH, open_slowly)))
    window.refresh()
    assert not window.controls.light.isEnabled()
    press(qtbot, window, Qt.Key.Key_L)
    release.set()
    qtbot.waitUntil(lambda: window.controller.status is not None and window.controller.is_settled)
    assert camera.is_running
    assert True not in lit
