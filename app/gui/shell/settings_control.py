"""Control of the settings of devices and reconstruction: the last choice wins, and is shown until it is in force."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial, reduce
from typing import Any

from PyQt6.QtCore import QTimer

from app.acquisition.instrument import Instrument
from app.bench.config import Bench
from app.gui.shell.controller import Controller, Then
from drivers.interface import BadValue, Camera, Devices

_BENCH = "bench"  # kind of the commands that change registration, reconstruction, lattice or mask
_MODES = {"amplifier", "readout_speed"}  # their commands return what else has changed
_FRAMES_MS = 500  # between two of them: they stop the camera

Command = Callable[[Instrument], Any]


class SettingsControl:
    """Sends what is wanted, one command of each kind at a time.

    Of the commands that come meanwhile, the last of each kind is kept; changes of the bench are joined into one.
    """

    def __init__(self, controller: Controller) -> None:
        self._controller = controller
        self._sent: set[str] = set()  # kinds of the commands under way
        self._next: dict[str, tuple[Callable[[], Command], Then]] = {}  # by kind
        self._changes: list[Callable[[Bench], Bench]] = []  # of the next command of the bench
        self._mask: str | None = None  # of the next command, too
        self._kinds: dict[str, str] = {}  # of the wanted settings
        self.wanted: dict[str, Any] = {}  # value of each setting that is not in force yet, by its name in the controls
        modes = CameraModes()
        self._commands: dict[str, Callable[[Devices, Any], Any]] = {
            "is_running": _set_running,
            "exposure_s": lambda on, value: on.camera.set_exposure(value),
            "em_gain": lambda on, value: on.camera.set_em_gain(value),
            "current_a": lambda on, value: on.light.set_current(value),
            "is_sample_in": lambda on, value: on.stage.note_sample(value),
            "amplifier": lambda on, value: modes.change(on.camera, amplifier=value),
            "readout_speed": lambda on, value: modes.change(on.camera, readout_speed=int(value)),
        }
        controller.connected.connect(self._restart)

    def _restart(self) -> None:
        """Forget all commands: another acquisition begins."""
        self._mask = None
        for each in (self._sent, self._next, self.wanted, self._changes):
            each.clear()

    def want(self, name: str, value: Any) -> None:
        """Set what the controls call `name`: a setting of a device, or one of the bench, "section.key"."""
        section, _, key = name.partition(".")
        is_of_bench = bool(key) or name == "mask"
        self.wanted[name], self._kinds[name] = value, _BENCH if is_of_bench else name
        if key:
            self.change(lambda now: replace(now, **{section: replace(getattr(now, section), **{key: value})}))
        elif is_of_bench:
            self._mask = value
            self.change(lambda bench: bench)
        else:
            command, then = self._commands[name], self._controller.messages.warn if name in _MODES else None
            self._keep(name, lambda: lambda on: command(on.devices, value), then)

    def change(self, change: Callable[[Bench], Bench], then: Then = None) -> None:
        """Change registration, reconstruction or lattice of the open bench; the devices stay open."""
        self._changes.append(change)
        _, earlier = self._next.get(_BENCH, (None, None))
        self._keep(_BENCH, self._change_bench, then or earlier)

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
        self._controller.send(
            lambda to: to.submit(command), partial(self._end, kind, then), partial(self._end, kind, None)
        )

    def _end(self, kind: str, then: Then, result: object) -> None:
        if then is not None:
            then(result)
        if kind == _BENCH and kind in self._next:
            QTimer.singleShot(_FRAMES_MS, partial(self._send_next, kind))
        else:
            self._send_next(kind)


def _set_running(devices: Devices, running: bool) -> None:
    if running and not devices.camera.is_running:
        devices.camera.start()
    elif not running:
        devices.camera.stop()


class CameraModes:
    """Changes amplifier and readout speed; a camera that returns to a mode gets its exposure and gain back."""

    def __init__(self) -> None:
        self._left: dict[tuple[str, int], tuple[float, float]] = {}  # exposure and gain by amplifier and speed

    def change(self, camera: Camera, *, amplifier: str | None = None, readout_speed: int | None = None) -> str:
        """Change one of both; return what else changed, or an empty text."""
        exposure_s, em_gain = self._left[camera.amplifier, camera.readout_speed] = camera.exposure_s, camera.em_gain
        with camera.paused():
            if amplifier is not None:
                camera.set_amplifier(amplifier)
            if readout_speed is not None:
                camera.set_readout_speed(readout_speed)
            if known := self._left.get((camera.amplifier, camera.readout_speed)):
                with suppress(BadValue):  # the region may have changed the limits
                    camera.set_exposure(known[0])
                    camera.set_em_gain(known[1])
        changes = (
            ("exposure", exposure_s * 1e3, camera.exposure_s * 1e3, " ms"),
            ("gain", em_gain, camera.em_gain, ""),
        )
        return ", ".join(
            f"{what} changed from {before:.4g} to {after:.4g}{unit}"
            for what, before, after, unit in changes
            if f"{before:.4g}" != f"{after:.4g}"
        )
