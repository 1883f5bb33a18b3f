"""The light goes off by its key, its button, a fault and at the end, and stays off until it is switched on."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest
from PyQt6.QtCore import Qt
from PyQt6.QtGui import QAction
from PyQt6.QtTest import QTest
from PyQt6.QtWidgets import QApplication, QDialog, QFileDialog, QMessageBox, QWidget
from pytestqt.qtbot import QtBot
from support.gui_bench import BENCH, FakeCamera, opener
from support.patience import HANG_S
from support.window_tools import MakeWindow, acquisition_of, click, press, wait_for_wavefront
from test_calibration_guide import ExposedCamera

from app.acquisition.instrument import Instrument
from app.acquisition.worker import Acquisition
from app.bench.config import Bench
from app.gui.shell.main_window import MainWindow
from app.measurement.measurement import Measurement
from app.results.player import InstrumentFactory
from drivers.interface import Devices, Disconnected, Frame


def focused(window: QWidget) -> QWidget:
    """Where a key goes that is pressed now."""
    return QApplication.focusWidget() or window


def activate(window: QWidget, qtbot: QtBot) -> None:
    window.activateWindow()
    qtbot.waitUntil(window.isActiveWindow)


def is_settled(window: MainWindow) -> bool:
    return window.controller.is_settled and not window.light.is_switching_off


def switch_off(window: MainWindow, qtbot: QtBot) -> None:
    activate(window, qtbot)
    press(qtbot, window, Qt.Key.Key_L)
    qtbot.waitUntil(lambda: window.controls.light.text() == "Light off" and is_settled(window))


@contextmanager
def blocked_reconstruction(monkeypatch: pytest.MonkeyPatch) -> Iterator[threading.Event]:
    """Hold the worker in a frame until the event is set, as with the slowest method."""
    begun, release = threading.Event(), threading.Event()

    def measure(_: Instrument, frame: Frame) -> Measurement:
        begun.set()
        release.wait()
        return Measurement(frame, None, "slow")

    monkeypatch.setattr(Instrument, "measure", measure)
    assert begun.wait(HANG_S)
    try:
        yield release
    finally:
        release.set()


DIALOGS: dict[str, Callable[[MainWindow], object]] = {
    "guide": lambda window: window.guide.show(),
    "settings": lambda window: window.benches.edit(),
    "fault": lambda window: window.benches.dialog.show_message("Faulty bench", "It is faulty", ()),
    "enlarged": lambda window: window.panels.wavefronts.enlarge(),
}


@pytest.mark.slow
@pytest.mark.usefixtures("no_rest")
def test_key_works_in_every_dialog(live: tuple[MainWindow, FakeCamera], qtbot: QtBot) -> None:
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
    actions = [action for action in live[0].findChildren(QAction) if not action.shortcut().isEmpty()]
    assert "L" in {action.shortcut().toString() for action in actions}
    assert not [action.text() for action in actions if action.autoRepeat()]


@pytest.mark.usefixtures("no_rest")
def test_letter_typed_into_a_text_is_only_typed(live: tuple[MainWindow, FakeCamera], qtbot: QtBot) -> None:
    window, camera = live
    activate(window, qtbot)
    window.recording_bar.prepare()
    qtbot.keyClicks(focused(window), "lens L")  # type: ignore[no-untyped-call] # pytest-qt declares no types for it
    press(qtbot, focused(window), Qt.Key.Key_Escape)
    window.controls.current.edit()
    press(qtbot, focused(window), Qt.Key.Key_L)
    qtbot.wait(200)
    assert camera.light.shines
    assert window.recording_bar.name.text() == "lens L"


def file_dialog(window: MainWindow) -> QFileDialog:
    return QFileDialog(window, "Open a bench")


def question(window: MainWindow) -> QMessageBox:
    return QMessageBox(QMessageBox.Icon.Question, "svwfs", "Keep the instrument running?", parent=window)


@pytest.mark.slow
@pytest.mark.usefixtures("no_rest")
@pytest.mark.parametrize("key", [Qt.Key.Key_F12, Qt.Key.Key_Pause])
@pytest.mark.parametrize("make", [file_dialog, question, None])
def test_emergency_key_works_in_modal_dialogs_and_texts(
    live: tuple[MainWindow, FakeCamera], qtbot: QtBot, key: Qt.Key, make: Callable[[MainWindow], QDialog] | None
) -> None:
    window, camera = live
    assert QApplication.testAttribute(Qt.ApplicationAttribute.AA_DontUseNativeDialogs)
    activate(window, qtbot)
    dialog = None if make is None else make(window)
    if dialog is None:
        window.recording_bar.prepare()
    else:
        dialog.setModal(True)
        dialog.show()
        activate(dialog, qtbot)
    for _ in range(2):  # never on
        handle = (dialog or window).windowHandle()
        assert handle is not None
        # As a keyboard: through shortcuts, then to the window.
        QTest.keyClick(handle, key)  # type: ignore[call-overload] # PyQt's stub lacks staticmethod
        qtbot.waitUntil(lambda: not camera.light.shines)
        qtbot.waitUntil(lambda: is_settled(window))
    if dialog is not None:
        dialog.close()
        dialog.deleteLater()


def test_key_during_a_dark_keeps_the_light_off(live: tuple[MainWindow, FakeCamera], qtbot: QtBot) -> None:
    window, camera = live
    window.controls.frames.setValue(1000)
    window.controls.dark.click()
    qtbot.waitUntil(lambda: window.controls.light.text() == "Light off")
    activate(window, qtbot)
    press(qtbot, window, Qt.Key.Key_L)
    qtbot.waitUntil(lambda: is_settled(window))
    assert not camera.light.shines
    assert camera.is_running


@pytest.mark.slow
@pytest.mark.usefixtures("no_rest")
def test_button_ends_the_guided_calibration(make_window: MakeWindow, qtbot: QtBot) -> None:
    camera = ExposedCamera()
    window = make_window(camera)
    window.connect_devices()
    wait_for_wavefront(qtbot, window)
    window.controls.calibrate.click()
    window.controls.light.click()
    qtbot.waitUntil(lambda: not camera.light.shines)
    qtbot.waitUntil(lambda: is_settled(window))
    assert window.guide.question.text() == "Ended: the light was switched off"
    assert not camera.light.shines


@pytest.mark.usefixtures("no_rest")
def test_button_works_while_a_frame_is_reconstructed(
    live: tuple[MainWindow, FakeCamera], qtbot: QtBot, monkeypatch: pytest.MonkeyPatch
) -> None:
    window, camera = live
    light = window.controls.light
    with blocked_reconstruction(monkeypatch):
        light.click()
        assert light.text().startswith("Switching off")
        qtbot.waitUntil(lambda: not camera.light.shines)
        qtbot.waitUntil(lambda: light.text() == "Light off" and not light.isChecked())
    light.click()
    qtbot.waitUntil(lambda: camera.light.shines and light.text() == "Light on")


@pytest.mark.slow
@pytest.mark.parametrize("by", ["key", "button"])
def test_light_that_was_just_switched_off_is_not_switched_on(
    live: tuple[MainWindow, FakeCamera], qtbot: QtBot, monkeypatch: pytest.MonkeyPatch, by: str
) -> None:
    """Neither a double click nor a held key, which some remote desktops send as many presses, lights it."""
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
    qtbot.waitUntil(lambda: is_settled(window))
    assert not window.controls.light.isChecked()
    qtbot.wait(3000)
    press_again()
    qtbot.waitUntil(lambda: camera.light.shines)


@pytest.mark.slow
def test_second_press_keeps_off_what_is_lighting_up(live: tuple[MainWindow, FakeCamera], qtbot: QtBot) -> None:
    window, camera = live
    switch_off(window, qtbot)
    busy = threading.Event()
    acquisition_of(window).commands.submit(lambda _: busy.wait(HANG_S))
    for _ in range(2):
        press(qtbot, window, Qt.Key.Key_L)
        window.controls.light.setChecked(False)
    busy.set()
    qtbot.waitUntil(lambda: is_settled(window))
    assert not camera.light.shines
    assert "light stays off" in window.messages.log


def test_light_that_does_not_go_off_raises_an_alarm(
    live: tuple[MainWindow, FakeCamera], qtbot: QtBot, monkeypatch: pytest.MonkeyPatch
) -> None:
    window, camera = live

    def refuse(**_: object) -> None:
        raise OSError("the cable is bad")

    with blocked_reconstruction(monkeypatch), monkeypatch.context() as patch:
        patch.setattr(camera.light, "_switch", refuse)
        window.controls.light.click()
        qtbot.waitUntil(lambda: "could not be switched off: the cable is bad" in window.messages.text.text())
        assert window.controls.light.text() == "Light on"


@pytest.mark.slow
@pytest.mark.parametrize("is_late", [False, True])
def test_fault_and_reconnection_leave_the_light_off(make_window: MakeWindow, qtbot: QtBot, *, is_late: bool) -> None:
    """Also if the light was switched off after the camera had failed."""
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
    assert not first.light.shines
    if is_late:
        press(qtbot, window, Qt.Key.Key_L)
    window.messages.reconnect.click()
    qtbot.waitUntil(lambda: second.is_running and window.controller.is_settled)
    assert window.controller.status is not None
    assert window.controller.status.dark.validity == "good"
    assert True not in lit
    assert "  The light stays off, as you left it: L switches it on" in window.messages.log


@pytest.mark.slow
def test_key_keeps_the_light_off_while_a_bench_opens(
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

    window.open(InstrumentFactory(lambda: Acquisition(BENCH, open_slowly)))
    window.refresh()
    assert not window.controls.light.isEnabled()
    press(qtbot, window, Qt.Key.Key_L)
    release.set()
    qtbot.waitUntil(lambda: window.controller.status is not None and window.controller.is_settled)
    assert camera.is_running
    assert True not in lit


def test_closing_turns_the_light_off_and_waits_visibly(
    live: tuple[MainWindow, FakeCamera], monkeypatch: pytest.MonkeyPatch
) -> None:
    window, camera = live
    seen: list[tuple[bool, bool, str]] = []
    with blocked_reconstruction(monkeypatch) as release:
        show_closing = window.messages.show_closing

        def note(light: str) -> None:
            show_closing(light)
            seen.append((window.isVisible(), camera.light.shines, window.messages.text.text()))
            if light == "the light is off":
                release.set()

        monkeypatch.setattr(window.messages, "show_closing", note)
        window.close()
    is_visible, shines, text = seen[-1]
    assert is_visible
    assert not shines
    assert text.startswith("Closing: the light is off; waiting for the frame")
    assert camera.is_closed
    assert not window.isVisible()
