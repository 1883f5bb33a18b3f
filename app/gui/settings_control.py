"""Control of the settings of devices and reconstruction: the last choice wins, and is shown until it is in force."""

from collections.abc import Callable
from functools import partial
from typing import Any

from PyQt6.QtCore import QTimer

from app.acquisition.instrument import Instrument
from app.gui.controls_panel import ControlsPanel
from app.gui.message_strip import MessageStrip

_BENCH = "bench"  # kind of the commands that change registration, reconstruction, lattice or mask
_FRAMES_MS = 500  # between two of them: they stop the camera

Command = tuple[Any, ...]  # a request of the instrument, and its arguments
Then = Callable[[Any], object] | None  # receives the result


class SettingsControl:
    """Sends what the controls request, one command of each kind at a time.

    Of the commands that come meanwhile, the last of each kind is kept; changes of the bench are joined into one.
    """

    def __init__(self, send: Callable[..., None], *, controls: ControlsPanel, messages: MessageStrip) -> None:
        """`send` takes what submits a command to the acquisition, and what receives its result or error."""
        self._send = send
        self._sent: set[str] = set()  # kinds of the commands under way
        self._next: dict[str, tuple[Callable[[], Command], Then]] = {}  # by kind
        self._changes: list[tuple[str, Any]] = []  # of the next command of the bench
        self._mask: str | None = None  # likewise
        self._kinds: dict[str, str] = {}  # of the wanted settings
        self.wanted: dict[str, Any] = {}  # value of each setting that is not in force yet, by its name in the controls
        for name, intent, setting, then in (
            ("running", controls.running_requested, "is_running", None),
            ("exposure", controls.exposure_requested, "exposure_s", None),
            ("em_gain", controls.em_gain_requested, "em_gain", None),
            ("current", controls.current_requested, "current_a", None),
            ("sample", controls.sample_requested, "is_sample_in", None),
            ("amplifier", controls.amplifier_requested, "amplifier", messages.warn),
            ("readout_speed", controls.readout_speed_requested, "readout_speed", messages.warn),
        ):
            intent.connect(partial(self._want, name, setting, then))
        controls.mask_requested.connect(self._want_mask)
        controls.setting_requested.connect(self._want_of_bench)

    def restart(self) -> None:
        """Forget all commands: another acquisition begins."""
        self._mask = None
        for each in (self._sent, self._next, self.wanted, self._changes):
            each.clear()

    def change(self, *changes: tuple[str, Any], then: Then = None) -> None:
        """Change settings of the open bench, see `Instrument.change_settings`; the devices stay open."""
        self._changes += changes
        _, earlier = self._next.get(_BENCH, (None, None))
        self._keep(_BENCH, self._change_bench, then or earlier)

    def _want(self, name: str, setting: str, then: Then, value: object) -> None:
        self.wanted[name], self._kinds[name] = value, name
        self._keep(name, lambda: (Instrument.set, setting, value), then)

    def _want_mask(self, mask: str) -> None:
        self._mask, self.wanted["mask"], self._kinds["mask"] = mask, mask, _BENCH
        self.change()

    def _want_of_bench(self, section: str, key: str, value: object) -> None:
        self.wanted[f"{section}.{key}"], self._kinds[f"{section}.{key}"] = value, _BENCH
        self.change((f"{section}.{key}", value))

    def _change_bench(self) -> Command:
        """Return one command for all changes of the bench, so that the reconstruction is prepared once."""
        changes, mask, self._changes, self._mask = self._changes, self._mask, [], None
        return Instrument.change_settings, changes, mask

    def _keep(self, kind: str, make: Callable[[], Command], then: Then) -> None:
        self._next[kind] = make, then
        if kind not in self._sent:
            self._send_next(kind)

    def _send_next(self, kind: str) -> None:
        self._sent.discard(kind)
        if kind not in self._next:
            self.wanted = {name: value for name, value in self.wanted.items() if self._kinds[name] != kind}
            return
        make, then = self._next.pop(kind)
        command = make()
        self._sent.add(kind)
        self._send(lambda to: to.submit(*command), partial(self._end, kind, then), partial(self._end, kind, None))

    def _end(self, kind: str, then: Then, result: object) -> None:
        if then is not None:
            then(result)
        if kind == _BENCH and kind in self._next:
            QTimer.singleShot(_FRAMES_MS, partial(self._send_next, kind))
        else:
            self._send_next(kind)
