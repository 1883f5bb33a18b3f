"""Controls: intents reach the devices, and the status of the devices is shown."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import get_args

import pytest
from PyQt6.QtCore import Qt
from pytestqt.qtbot import QtBot
from support.gui_bench import FakeCamera
from support.patience import HANG_S
from support.window_tools import MakeWindow, count_pixels, press, wait_for_wavefront

from app.acquisition.command_queue import CommandQueue
from app.acquisition.dark_reference_store import AverageState
from app.acquisition.instrument import Commands
from app.bench.device_kinds import DRIVERS
from app.bench.settings_form import NAMES, name_of
from app.gui.shell.main_window import MainWindow
from app.gui.widgets import theme
from app.measurement.averages import AVERAGED_FRAMES
from reconstruction.settings import Method, PupilBasis, RegistrationSettings


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.usefixtures("no_rest")
def test_intents_reach_the_devices(live: tuple[MainWindow, FakeCamera], qtbot: QtBot) -> None:
    window, camera = live
    controls = window.controls
    acts: tuple[tuple[Callable[[], object], Callable[[], bool]], ...] = (
        (lambda: press(qtbot, window, Qt.Key.Key_Space), lambda: not camera.is_running),
        (controls.light.click, lambda: not camera.light.is_on),
        (controls.sample.click, lambda: not camera.stage.is_sample_in),
        (lambda: controls.exposure.setValue(30.4), lambda: camera.exposure_s == 0.03),
        (lambda: controls.em_gain.setValue(7), lambda: camera.em_gain == 7),
        (lambda: controls.current.setValue(120), lambda: camera.light.current_a == pytest.approx(0.12)),
        (lambda: controls.wanted.emit("mask", "stars"), lambda: camera.stage.mask == "stars"),
        (controls.start.click, lambda: camera.is_running),
        (lambda: controls.wanted.emit(Commands.set_amplifier, "normal"), lambda: camera.amplifier == "normal"),
    )
    for act, is_done in acts:
        act()
        qtbot.waitUntil(is_done)
        qtbot.waitUntil(lambda: window.controller.is_settled)
    assert camera.is_running
    qtbot.waitUntil(lambda: controls.exposure.value() == 30.0)  # as rounded by the camera
    qtbot.waitUntil(lambda: controls.light.text() == "Light off")  # after "Switching off"
    assert controls.choices["amplifier"].currentText() == "normal"
    controls.light.click()
    qtbot.waitUntil(lambda: "was taken with another amplifier" in window.messages.text.text())


class ThreeSpeeds(FakeCamera):
    """Also reads out at three speeds."""

    def __init__(self) -> None:
        super().__init__()
        self._capabilities = replace(self._capabilities, readout_speeds=(1, 2, 3))
        self._speed = 3

    def _read_readout_speed(self) -> int:
        return self._speed

    def _set_readout_speed(self, readout_speed: int) -> None:
        self._speed = readout_speed


@pytest.mark.slow
@pytest.mark.long
def test_every_choice_reaches_the_instrument(make_window: MakeWindow, qtbot: QtBot) -> None:
    window = make_window(ThreeSpeeds())
    window.connect_devices()
    wait_for_wavefront(qtbot, window)
    for name, choice in window.controls.choices.items():
        assert choice.isEnabled(), name
        index = (choice.currentIndex() + 1) % choice.count()
        wanted = choice.itemData(index)
        choice.setCurrentIndex(index)  # as a user does
        choice.activated.emit(index)
        qtbot.waitUntil(lambda: window.controller.is_settled and not window.settings.wanted)
        status = window.controller.status
        assert status is not None
        assert getattr(status, name) == wanted, name
        assert choice.itemData(choice.currentIndex()) == wanted, name
    assert "display failed" not in window.messages.log


def is_exposed(camera: FakeCamera, exposure_s: float) -> bool:
    return camera.exposure_s == exposure_s


def test_return_applies_typed_number_and_escape_restores_it(live: tuple[MainWindow, FakeCamera], qtbot: QtBot) -> None:
    """Both keys are shortcuts of the window, too, except while a number is edited."""
    window, camera = live
    answers: list[bool] = []
    window.messages.answered.connect(answers.append)
    window.messages.ask("use it?")
    window.activateWindow()
    field = window.controls.exposure
    for keys, end, exposure_s in (("40", Qt.Key.Key_Return, 0.04), ("30", Qt.Key.Key_Escape, 0.04)):
        press(qtbot, window, Qt.Key.Key_E)
        qtbot.waitUntil(field.hasFocus)
        for key in keys:
            press(qtbot, field, Qt.Key(ord(key)))
        press(qtbot, field, end)
        qtbot.waitUntil(partial(is_exposed, camera, exposure_s))
        qtbot.waitUntil(lambda: window.controller.is_settled)
        assert field.value() == 40
        assert field.text() == "40.000"
        assert not field.hasFocus()  # digits are shortcuts again
    assert not answers
    qtbot.waitUntil(window.messages.accept.isVisible)
    press(qtbot, window, Qt.Key.Key_Return)
    qtbot.waitUntil(lambda: answers == [True])


@pytest.mark.slow
def test_notice_disappears_at_the_next_command(
    live: tuple[MainWindow, FakeCamera], qtbot: QtBot, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("app.gui.shell.messages._NOTICE_S", 1e9)  # it does not expire
    window, _ = live
    window.messages.inform("the exposure was found")
    window.update_text()
    assert window.messages.text.text() == "The exposure was found"
    window.controls.light.click()
    qtbot.waitUntil(lambda: window.messages.text.text() == "The light is off: switch it on (L)")


def test_fields_take_their_limits_from_settings_and_devices(live: tuple[MainWindow, FakeCamera]) -> None:
    window, _ = live
    controls, status = window.controls, window._status
    assert status is not None
    assert (controls.frames.minimum(), controls.frames.maximum()) == (AVERAGED_FRAMES[0], AVERAGED_FRAMES[-1])
    for field, unit, allowed in (
        (controls.exposure, 1e-3, status.capabilities.exposure_range_s),
        (controls.em_gain, 1, status.capabilities.em_gain_range),
        (controls.current, 1e-3, status.current_range_a),
    ):
        assert (field.minimum() * unit, field.maximum() * unit) == pytest.approx((allowed.minimum, allowed.maximum))


def test_lamps_show_validity_of_dark_and_reference(live: tuple[MainWindow, FakeCamera]) -> None:
    window, _ = live
    assert window._status is not None
    status = window._status

    def lamps(dark: AverageState, reference: AverageState) -> tuple[str, str]:
        shown = replace(status, dark=dark, reference=reference)
        window.controls.show_status(shown)
        images = [
            button.icon().pixmap(32, 32).toImage() for button in (window.controls.dark, window.controls.reference)
        ]
        of_dark, of_reference = (image.pixelColor(16, 25).name() for image in images)
        return of_dark, of_reference

    green, amber, off = theme.GREEN.name(), theme.AMBER.name(), theme.DIM.name()
    good, missing = AverageState("20 frames"), AverageState()
    doubtful = replace(good, doubt="of another exposure")
    assert lamps(good, good) == (green, green)
    assert lamps(good, doubtful) == (green, amber)
    assert lamps(doubtful, missing) == (amber, off)


@pytest.mark.slow
def test_steps_show_time_and_brightness_in_the_order_of_work(live: tuple[MainWindow, FakeCamera], qtbot: QtBot) -> None:
    window, camera = live
    controls = window.controls
    steps = (controls.lattice, controls.auto_exposure, controls.dark, controls.reference, controls.calibrate)
    assert [one.text().split()[0] for one in steps] == ["1", "2", "3", "4", "Calibrate…"]
    places = [one.mapTo(window, one.rect().topLeft()) for one in steps]
    assert places == sorted(places, key=lambda place: (place.y(), place.x()))  # as one reads
    taken = window.controls.dark.toolTip().partition("6 frames at ")[2][:5]
    assert controls.dark.text() == f"3 Dark  {taken}"
    assert window.shown.measurement is not None
    share = window.shown.measurement.frame.pixels.max() / 65535
    count_pixels(qtbot, window)
    assert controls.auto_exposure.text() == f"2 Exposure  {100 * share:.0f} %"
    assert "Good" in controls.auto_exposure.toolTip()
    camera.light.set_on(False)
    qtbot.waitUntil(lambda: "Doubtful" in controls.auto_exposure.toolTip())


@pytest.mark.slow
@pytest.mark.long
def test_refused_value_is_shown_and_loop_continues(live: tuple[MainWindow, FakeCamera], qtbot: QtBot) -> None:
    window, camera = live
    window.controls.exposure.setValue(55)
    qtbot.waitUntil(lambda: "between 50 and 60 ms are broken" in window.messages.text.text())
    assert window.controls.exposure.value() == 20.0
    shown = window.status_line.shown
    qtbot.waitUntil(lambda: window.status_line.shown > shown + 3)
    assert camera.exposure_s == 0.02


def test_method_that_the_reference_chose_is_shown(live: tuple[MainWindow, FakeCamera], qtbot: QtBot) -> None:
    window, _ = live
    assert window.controller.acquisition is not None
    change = "registration", RegistrationSettings()
    window.controller.acquisition.change_settings([change]).result(HANG_S)
    assert window.controller.status is not None
    assert window.controller.status.bench.registration.named_method == "automatic"
    qtbot.waitUntil(lambda: window.controls.method.text().startswith("Method: Gauss-Newton"))


def test_no_method_is_shown_as_a_word_of_code() -> None:
    for word in (*get_args(Method), *get_args(PupilBasis)):
        assert "_" not in name_of(word)
    assert NAMES.keys() <= {*get_args(Method), *get_args(PupilBasis), *DRIVERS["camera"], *DRIVERS["light"]}


def test_exposure_passes_eight_functions_to_the_driver(
    live: tuple[MainWindow, FakeCamera], qtbot: QtBot, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A reader who clicks on names can follow it."""
    (window, camera), passed = live, list[str]()
    submit, set_exposure = CommandQueue.submit, FakeCamera._set_exposure

    def note(function: Callable[..., object], before: str) -> Callable[..., object]:
        def noting(*arguments: object) -> object:
            names = [each.function for each in inspect.stack()[1:]]
            passed.extend(reversed(names[: names.index(before)]))
            return function(*arguments)

        return noting

    monkeypatch.setattr(CommandQueue, "submit", note(submit, "test_exposure_passes_eight_functions_to_the_driver"))
    monkeypatch.setattr(FakeCamera, "_set_exposure", note(set_exposure, "_work"))
    window.controls.exposure.setValue(30)
    qtbot.waitUntil(lambda: camera.exposure_s == 0.03)
    assert len(passed) + 1 <= 8, passed  # with `submit` itself
