"""Control of the settings of devices and reconstruction: the last choice wins, and is shown until it is in force."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial, reduce
from typing import Any

from PyQt6.QtCore import QTimer

from app.acquisition.instrument import Instrument
from app.bench.config import Bench
from app.gui.controls_panel import ControlsPanel
from app.gui.device_commands import CameraModes, set_running
from app.gui.message_strip import MessageStrip
from drivers.interface import Devices

_BENCH = "bench"  # kind of the commands that change registration, reconstruction, lattice or mask
_FRAMES_MS = 500  # between two of them: they stop the camera

Command = Callable[[Instrument], Any]
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
        self._changes: list[Callable[[Bench], Bench]] = []  # of the next command of the bench
        self._mask: str | None = None  # likewise
        self._kinds: dict[str, str] = {}  # of the wanted settings
        self.wanted: dict[str, Any] = {}  # value of each setting that is not in force yet, by its name in the controls
        modes = CameraModes()
        for name, intent, command, then in (
            ("running", controls.running_requested, set_running, None),
            ("exposure", controls.exposure_requested, lambda on, value: on.camera.set_exposure(value), None),
            ("em_gain", controls.em_gain_requested, lambda on, value: on.camera.set_em_gain(value), None),
            ("current", controls.current_requested, lambda on, value: on.light.set_current(value), None),
            ("sample", controls.sample_requested, lambda on, value: on.stage.note_sample(value), None),
            ("amplifier", controls.amplifier_requested, modes.set_amplifier, messages.warn),
            ("readout_speed", controls.readout_speed_requested, modes.set_readout_speed, messages.warn),
        ):
            intent.connect(partial(self._want, name, command, then))
        controls.mask_requested.connect(self._want_mask)
        controls.setting_requested.connect(self._want_of_bench)

    def restart(self) -> None:
        """Forget all commands: another acquisition begins."""
        self._mask = None
        for each in (self._sent, self._next, self.wanted, self._changes):
            each.clear()

    def change(self, change: Callable[[Bench], Bench], then: Then = None) -> None:
        """Change registration, reconstruction or lattice of the open bench; the devices stay open."""
        self._changes.append(change)
        _, earlier = self._next.get(_BENCH, (None, None))
        self._keep(_BENCH, self._change_bench, then or earlier)

    def _want(self, name: str, command: Callable[[Devices, Any], Any], then: Then, value: object) -> None:
        self.wanted[name], self._kinds[name] = value, name
        self._keep(name, lambda: lambda on: command(on.devices, value), then)

    def _want_mask(self, mask: str) -> None:
        self._mask, self.wanted["mask"], self._kinds["mask"] = mask, mask, _BENCH
        self.change(lambda bench: bench)

    def _want_of_bench(self, section: str, key: str, value: object) -> None:
        self.wanted[f"{section}.{key}"], self._kinds[f"{section}.{key}"] = value, _BENCH
        self.change(lambda now: replace(now, **{section: replace(getattr(now, section), **{key: value})}))

    def _change_bench(self) -> Command:
        """Return one command for all changes of the bench, so that the reconstruction is prepared once."""
        changes, mask, self._changes, self._mask = self._changes, self._mask, [], None
        return lambda on: on.change_settings(lambda bench: reduce(lambda now, each: each(now), changes, bench), mask)

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
        self._send(lambda to: to.submit(command), partial(self._end, kind, then), partial(self._end, kind, None))

    def _end(self, kind: str, then: Then, result: object) -> None:
        if then is not None:
            then(result)
        if kind == _BENCH and kind in self._next:
            QTimer.singleShot(_FRAMES_MS, partial(self._send_next, kind))
        else:
            self._send_next(kind)
