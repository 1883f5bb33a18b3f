"""Control of the settings of devices and reconstruction: the last choice wins, and is shown until it is in force."""

from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple, Protocol

from app.acquisition.instrument import Instrument
from app.acquisition.worker import Acquisition
from app.bench.config import Bench
from app.gui.controls_panel import ControlsPanel
from app.gui.device_commands import CameraModes, set_running
from app.gui.message_strip import MessageStrip
from drivers.interface import Devices

_BENCH = "bench"  # kind of the commands that change registration, reconstruction or lattice

Then = Callable[[Any], object]


class _Send(Protocol):
    def __call__(
        self, submit: Callable[[Acquisition], Future[Any]], then: Then | None, otherwise: Callable[[Exception], object]
    ) -> None: ...


class _Command(NamedTuple):
    run: Callable[[Instrument], Any]
    then: Then | None = None  # receives the result


class SettingsControl:
    """Sends what the controls request, one command of each kind at a time.

    Of the commands that come meanwhile, the last of each kind is kept; changes of the bench are joined into one.
    """

    def __init__(self, send: _Send, *, controls: ControlsPanel, messages: MessageStrip) -> None:
        """`send` queues a command for the acquisition."""
        self._send = send
        self._sent: set[str] = set()  # kinds of the commands under way
        self._next: dict[str, _Command] = {}  # by kind
        self._changes: list[tuple[Callable[[Bench], Bench], Then | None]] = []  # of the bench, not sent yet
        self._kinds: dict[str, str] = {}  # of the wanted settings
        self.wanted: dict[str, Any] = {}  # value of each setting that is not in force yet, by its name in the controls
        self._shown: dict[str, Any] = {}  # what `poll` has told
        modes = CameraModes()
        camera: tuple[tuple[str, Any, Callable[[Devices, Any], Any], Then | None], ...] = (
            ("running", controls.running_requested, set_running, None),
            ("exposure", controls.exposure_requested, lambda on, value: on.camera.set_exposure(value), None),
            ("em_gain", controls.em_gain_requested, lambda on, value: on.camera.set_em_gain(value), None),
            ("current", controls.current_requested, lambda on, value: on.light.set_current(value), None),
            ("sample", controls.sample_requested, lambda on, value: on.stage.note_sample(value), None),
            ("amplifier", controls.amplifier_requested, modes.set_amplifier, messages.warn),
            ("readout_speed", controls.readout_speed_requested, modes.set_readout_speed, messages.warn),
        )
        for name, intent, command, then in camera:
            intent.connect(partial(self._want_of_devices, name, command, then))
        controls.mask_requested.connect(lambda mask: self._want("mask", mask, lambda on: on.set_mask(mask)))
        controls.setting_requested.connect(self._want_of_bench)

    def restart(self) -> None:
        """Forget all commands: another acquisition begins."""
        self._sent.clear()
        self._next.clear()
        self._changes.clear()
        self.wanted.clear()

    def poll(self) -> bool:
        """Return whether `wanted` has changed since the last call."""
        before, self._shown = self._shown, dict(self.wanted)
        return before != self._shown

    def change(self, change: Callable[[Bench], Bench], then: Then | None = None) -> None:
        """Change registration, reconstruction or lattice of the open bench; the devices stay open."""
        self._changes.append((change, then))
        self._send_next(_BENCH)

    def _want_of_devices(
        self, name: str, command: Callable[[Devices, Any], Any], then: Then | None, value: object
    ) -> None:
        self._want(name, value, lambda instrument: command(instrument.devices, value), then)

    def _want_of_bench(self, section: str, key: str, value: object) -> None:
        self.wanted[f"{section}.{key}"], self._kinds[f"{section}.{key}"] = value, _BENCH
        self.change(lambda now: replace(now, **{section: replace(getattr(now, section), **{key: value})}))

    def _want(self, name: str, value: object, run: Callable[[Instrument], Any], then: Then | None = None) -> None:
        self.wanted[name], self._kinds[name] = value, name
        self._next[name] = _Command(run, then)
        self._send_next(name)

    def _send_next(self, kind: str) -> None:
        """Send what is wanted of this kind, unless a command is under way."""
        if kind in self._sent:
            return
        if kind == _BENCH and self._changes:
            self._next[kind] = _joined(self._changes)
            self._changes = []
        if (command := self._next.pop(kind, None)) is None:
            self.wanted = {name: value for name, value in self.wanted.items() if self._kinds[name] != kind}
            return
        self._sent.add(kind)
        self._send(
            lambda to: to.submit(command.run), partial(self._end, kind, command.then), partial(self._end, kind, None)
        )

    def _end(self, kind: str, then: Then | None, result: object) -> None:
        self._sent.discard(kind)
        self._send_next(kind)
        if then is not None:
            then(result)


def _joined(changes: list[tuple[Callable[[Bench], Bench], Then | None]]) -> _Command:
    """Join changes of the bench into one command, so that the reconstruction is prepared once."""

    def changed(bench: Bench) -> Bench:
        for change, _ in changes:
            bench = change(bench)
        return bench

    def then(result: object) -> None:
        for _, each in changes:
            if each is not None:
                each(result)

    return _Command(lambda instrument: instrument.change_settings(changed), then)
