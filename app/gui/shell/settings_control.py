"""Wanted settings of the devices and of the bench, sent one after the other."""

from collections.abc import Callable
from functools import partial
from typing import Any

from PyQt6.QtCore import QTimer

from app.acquisition.instrument import Instrument
from app.gui.shell.controller import Controller, Then

Call = tuple[Any, ...]  # a request of the instrument, and its arguments

_BENCH = "bench"  # kind of the commands that change registration, reconstruction, lattice or mask
_MODES = {"amplifier", "readout_speed"}  # their commands return what else has changed
_FRAMES_MS = 500  # between two of them: they stop the camera


class SettingsControl:
    """Sends what is wanted, one command of each kind at a time.

    Of the commands that come meanwhile, the last of each kind is kept; changes of the bench are joined into one.
    """

    def __init__(self, controller: Controller) -> None:
        self._controller = controller
        self._sent: set[str] = set()  # kinds of the commands under way
        self._next: dict[str, tuple[Callable[[], Call], Then]] = {}  # by kind
        self._changes: list[tuple[str, Any]] = []  # of the next command of the bench
        self._mask: str | None = None  # of the next command, too
        self._kinds: dict[str, str] = {}  # of the wanted settings
        self.wanted: dict[str, Any] = {}  # value of each setting that is not in force yet, by its name in the controls
        controller.connected.connect(self._restart)

    def _restart(self) -> None:
        """Forget all commands: another acquisition begins."""
        self._mask = None
        for each in (self._sent, self._next, self.wanted, self._changes):
            each.clear()

    def want(self, name: str, value: Any) -> None:
        """Set what the controls call `name`: a setting of a device, or one of the bench, "section.key"."""
        is_of_bench = "." in name or name == "mask"
        self.wanted[name], self._kinds[name] = value, _BENCH if is_of_bench else name
        if "." in name:
            self.change((name, value))
        elif is_of_bench:
            self._mask = value
            self.change()
        else:
            then = self._controller.messages.warn if name in _MODES else None
            self._keep(name, lambda: (Instrument.set, name, value), then)

    def change(self, *changes: tuple[str, Any], then: Then = None) -> None:
        """Change settings of the open bench, see `Instrument.change_settings`; the devices stay open."""
        self._changes += changes
        _, earlier = self._next.get(_BENCH, (None, None))
        self._keep(_BENCH, self._change_bench, then or earlier)

    def _change_bench(self) -> Call:
        """Return one command for all changes of the bench, so that the reconstruction is prepared once."""
        changes, mask, self._changes, self._mask = self._changes, self._mask, [], None
        return Instrument.change_settings, changes, mask

    def _keep(self, kind: str, make: Callable[[], Call], then: Then) -> None:
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
        self._controller.send(
            lambda to: to.submit(*command), partial(self._end, kind, then), partial(self._end, kind, None)
        )

    def _end(self, kind: str, then: Then, result: object) -> None:
        if then is not None:
            then(result)
        if kind == _BENCH and kind in self._next:
            QTimer.singleShot(_FRAMES_MS, partial(self._send_next, kind))
        else:
            self._send_next(kind)
