"""Control of the light, also of a manual one, and of the averages that need it on or off."""

import math
import time
from collections.abc import Callable
from concurrent.futures import Future
from functools import partial

from PyQt6.QtCore import QEvent, QObject, Qt
from PyQt6.QtGui import QKeyEvent, QWindow
from PyQt6.QtWidgets import QApplication

from app.acquisition.address import running
from app.acquisition.remote.connection import RunningInstrument, switch_light_off
from app.acquisition.start_up import CalibrationStep
from app.gui.panels.controls import ControlsPanel
from app.gui.shell.controller import Controller
from app.progress import counted, run_in_thread

_REST_S = 1.0  # after a request to switch off: the second click of a double click, or a held key, lights nothing

_EMERGENCY = (Qt.Key.Key_F12, Qt.Key.Key_Pause)


class EmergencyKeys(QObject):
    """Calls `act` at F12 or Pause in every window of the program, also in modal dialogs, which block shortcuts."""

    def __init__(self, act: Callable[[], object], parent: QObject) -> None:
        super().__init__(parent)
        self._act = act
        if isinstance(application := QApplication.instance(), QApplication):
            application.setAttribute(Qt.ApplicationAttribute.AA_DontUseNativeDialogs)  # they would not see the keys
            application.focusWindowChanged.connect(self._watch)

    def _watch(self, window: QWindow | None) -> None:
        if window is not None:
            window.installEventFilter(self)

    def eventFilter(self, _: QObject | None, event: QEvent | None) -> bool:  # noqa: N802 - Qt's name
        if not isinstance(event, QKeyEvent) or event.type() != QEvent.Type.KeyPress or event.key() not in _EMERGENCY:
            return False
        if not event.isAutoRepeat():
            self._act()
        return True


class LightControl:
    """Switches the light and takes dark and reference; a request to switch it off wins over all others."""

    def __init__(self, controller: Controller, controls: ControlsPanel, end_sequence: Callable[[], bool]) -> None:
        """`end_sequence` ends a sequence of commands, and returns whether one was running."""
        self._controller, self._controls, self._messages = controller, controls, controller.messages
        self._end_sequence = end_sequence
        self._switching_off: Future[None] | None = None
        self._elsewhere: dict[str, Future[None]] = {}  # lights of other instruments that are being switched off
        self._rests_until_s = -math.inf
        self.is_kept_off = False  # whether the user's last request was to switch off

    @property
    def is_switching_off(self) -> bool:
        return self._switching_off is not None

    @property
    def _acquisition(self) -> RunningInstrument | None:
        """The acquisition, while its worker can still switch the light."""
        acquisition = self._controller.acquisition
        return acquisition if acquisition is not None and acquisition.is_alive else None

    def poll(self) -> bool:
        """Return whether a request to switch off has ended since the last call; show its error, if any."""
        for name in [name for name, future in self._elsewhere.items() if future.done()]:
            if (failed := self._elsewhere.pop(name).exception()) is None:
                self._messages.inform(f"the light of {name} is off")
            else:
                self._messages.alarm(f"the light of {name} could not be switched off: {failed}")
        if self._switching_off is None or not self._switching_off.done():
            return False
        error, self._switching_off = self._switching_off.exception(), None
        if error is not None:
            self._messages.alarm(f"the light could not be switched off: {error}")
        return True

    def ask_off(self, then: Callable[[], object]) -> None:
        """Call `then`, after a person has switched a manual light off."""
        if self._acquisition is not None and self._must_ask(is_on=False):
            self._ask_by_hand(is_on=False, then=then)
        else:
            then()

    def switch_off(self) -> None:
        self.switch(is_on=False)

    def switch(self, *, is_on: bool) -> None:
        """Switch the light, and end a sequence. While a command waits or runs, it may be lighting up: always off.

        So two requests in a row never light it, whatever the first one did.
        """
        acquisition, status = self._acquisition, self._controller.status
        if status is not None and status.is_replay:
            self._switch_off_elsewhere()
            return
        if acquisition is None:
            self.is_kept_off = True  # when the bench that is being read, or that has failed, connects
            return
        has_ended, now_s = self._end_sequence(), time.monotonic()
        is_busy, is_resting = has_ended or self._is_busy(acquisition), now_s < self._rests_until_s
        if status is not None and status.bench.has_manual_light:
            if has_ended:
                self._controller.cancel()
            self._controls.light.setChecked(status.is_light_on)  # until it is confirmed
            self._ask_by_hand(is_on=is_on)
        elif is_on and not is_busy and not is_resting:
            self.is_kept_off = False
            self._controller.send(lambda to: to.set_light_on(True))
        else:
            self.is_kept_off, self._rests_until_s = True, now_s + _REST_S
            self._switching_off = acquisition.switch_light_off()
            self._messages.clear_notice()
            if is_on:
                why = "it was switched off within the last second" if is_resting else "commands were waiting"
                self._messages.warn(f"the light stays off: {why}; L switches it on")
            self._controls.light.setChecked(False)
            self._controls.show_switching_off()

    def _switch_off_elsewhere(self) -> None:
        """Switch off the lights of all instruments of this user: that of a recording shines on nobody."""
        switched = {name: run_in_thread(partial(switch_light_off, name), "light off")[0] for name in running()}
        self._elsewhere |= switched
        if not switched:
            self._messages.warn(
                "no light was switched off: this window plays a recording, and no instrument of yours runs"
            )

    def _is_busy(self, acquisition: RunningInstrument) -> bool:
        return bool(acquisition.activity.text) or self.is_switching_off or not self._controller.is_idle

    def take(self, step: CalibrationStep, frames: int) -> None:
        if self._must_ask(is_on=step.is_lit):
            self._ask_by_hand(is_on=step.is_lit, then=lambda: self.take(step, frames))
        else:
            self._controller.send(lambda to: step.begin(to, frames), lambda _: self._confirm(step, frames))

    def _confirm(self, step: CalibrationStep, frames: int) -> None:
        """Tell that an average was taken, if it is usable, and ask for light after a dark."""
        status, name = self._controller.status, step.title.lower()
        if status is not None and getattr(status, name).validity == "good":
            self._messages.inform(f"{name} taken: mean of {counted(frames)}; Ctrl+Z restores the one before")
        if self._must_ask(is_on=True):
            self._ask_by_hand(is_on=True)

    def _must_ask(self, *, is_on: bool) -> bool:
        status = self._controller.status
        return status is not None and status.bench.has_manual_light and status.is_light_on != is_on

    def _ask_by_hand(self, *, is_on: bool, then: Callable[[], object] = lambda: None) -> None:
        """Ask a person to switch a manual light, and note it when that is confirmed."""
        self._messages.ask(
            f"switch the light {'on' if is_on else 'off'} by hand",
            lambda: self._controller.send(lambda to: to.set_light_on(is_on), lambda _: then()),
            "Done",
            "Not now",
        )
