"""Control of the light, and of the averages that need it on or off; a person is asked to switch a manual one."""

from collections.abc import Callable
from concurrent.futures import Future
from typing import Literal, Protocol

from app.acquisition.instrument import Instrument
from app.acquisition.worker import Acquisition
from app.gui.controls_panel import ControlsPanel
from app.gui.message_strip import MessageStrip
from app.progress import counted


class _Send(Protocol):
    def __call__(
        self, submit: Callable[[Acquisition], Future[None]], then: Callable[[None], object] | None
    ) -> None: ...


class LightControl:
    """Switches the light and takes dark and reference as the controls request."""

    def __init__(
        self,
        acquisition: Callable[[], Acquisition | None],
        send: _Send,
        ask: Callable[[str, Callable[[], object], str, str], None],
        is_idle: Callable[[], bool],
        *,
        controls: ControlsPanel,
        messages: MessageStrip,
    ) -> None:
        """`send(command)` queues it for the acquisition; `ask(question, on_accept, accept_label, cancel_label)`.

        `is_idle` tells whether all commands that were sent are finished.
        """
        self._acquisition, self._send, self._ask, self._is_idle = acquisition, send, ask, is_idle
        self._controls, self._messages = controls, messages
        self._switching_off: Future[None] | None = None
        self.end_sequence: Callable[[], bool] = lambda: False  # of commands; returns whether one was running
        controls.light_requested.connect(self._switch)
        controls.dark_requested.connect(self._take_dark)
        controls.reference_requested.connect(self._take_reference)

    @property
    def is_switching_off(self) -> bool:
        """True while the light is being switched off."""
        return self._switching_off is not None

    def poll(self) -> bool:
        """Return whether a request to switch off has ended since the last call; raise an alarm if it failed."""
        if self._switching_off is None or not self._switching_off.done():
            return False
        error, self._switching_off = self._switching_off.exception(), None
        if error is not None:
            self._messages.alarm(f"the light could not be switched off: {error}")
        return True

    def ask_off(self, then: Callable[[], object]) -> bool:
        """Return whether a person must switch the light off first; then ask for that, and call `then` afterwards."""
        acquisition = self._acquisition()
        if acquisition is None or not acquisition.is_alive or not self._must_ask(on=False):
            return False
        self._ask_by_hand(on=False, then=then)
        return True

    def _switch(self, on: bool) -> None:
        """Switch the light, and end a sequence. While a command waits or runs, it may be lighting up: always off.

        So two requests in a row never light it, whatever the first one did.
        """
        acquisition = self._acquisition()
        if acquisition is None or not acquisition.is_alive:
            return
        has_ended, status = self.end_sequence(), acquisition.status
        may_light = not (has_ended or acquisition.activity.text or self.is_switching_off) and self._is_idle()
        if status is not None and status.bench.has_manual_light:
            if has_ended:
                acquisition.cancel()
            self._controls.light.setChecked(status.is_light_on)  # until it is confirmed
            self._ask_by_hand(on=on, then=lambda: None)
        elif on and may_light:
            self._send(lambda to: to.submit(Instrument.set, "is_light_on", True), None)
        else:
            self._switching_off = acquisition.switch_light_off()
            self._messages.clear_notice()
            if on:
                self._messages.warn("the light stays off: commands were waiting; L switches it on")
            self._controls.light.setChecked(False)
            self._controls.show_switching_off()

    def _take_dark(self, frames: int) -> None:
        if self._must_ask(on=False):
            self._ask_by_hand(on=False, then=lambda: self._take_dark(frames))
        else:
            self._send(lambda to: to.submit(Instrument.take_dark, frames), lambda _: self._dark_taken(frames))

    def _take_reference(self, frames: int) -> None:
        if self._must_ask(on=True):
            self._ask_by_hand(on=True, then=lambda: self._take_reference(frames))
        else:
            take = Instrument.take_reference
            self._send(lambda to: to.submit(take, frames), lambda _: self._confirm("reference", frames))

    def _dark_taken(self, frames: int) -> None:
        self._confirm("dark", frames)
        if self._must_ask(on=True):
            self._ask_by_hand(on=True, then=lambda: None)

    def _confirm(self, name: Literal["dark", "reference"], frames: int) -> None:
        """Tell that an average was taken; if it is unusable, the warning tells why."""
        acquisition = self._acquisition()
        status = None if acquisition is None else acquisition.status
        if status is not None and getattr(status, name) == "good":
            self._messages.inform(f"{name} taken: mean of {counted(frames)}")

    def _must_ask(self, *, on: bool) -> bool:
        acquisition = self._acquisition()
        status = None if acquisition is None else acquisition.status
        return status is not None and status.bench.has_manual_light and status.is_light_on != on

    def _ask_by_hand(self, *, on: bool, then: Callable[[], object]) -> None:
        """Ask a person to switch a manual light, and note it when that is confirmed."""
        self._ask(
            f"switch the light {'on' if on else 'off'} by hand",
            lambda: self._send(lambda to: to.submit(Instrument.set, "is_light_on", on), lambda _: then()),
            "Done",
            "Not now",
        )
