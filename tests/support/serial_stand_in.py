"""What the tests of serial lights share: a driver over a stand-in in memory, on a clock that takes no time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, get_args

from hypothesis import strategies as st

from drivers.serial_lights.line import Wire
from simulated_devices.clock import ManualClock
from simulated_devices.wires.pseudo_terminal import PtyServer
from simulated_devices.wires.serial import FaultKind, LineDevice, LineFault, MemoryPort
from support.light_storm import LightStorm


def wire_to(device: LineDevice, clock: ManualClock) -> Wire:
    """Whatever port is opened, that device is there."""
    return Wire(open_port=lambda _port, **_settings: MemoryPort(device, clock), clock=clock.now)


class SerialFaults:
    """The hand at the cable of a light in memory."""

    def __init__(self, device: Any) -> None:
        self.device = device

    @property
    def shines(self) -> bool:
        return bool(self.device.is_lit)

    def fail_next(self) -> None:
        self.device.faults.append(LineFault("silence"))

    def refuse_next(self) -> None:
        self.device.refuses_next = True

    def unplug(self) -> None:
        self.device.is_unplugged = True

    def plug_in(self) -> None:
        self.device.is_unplugged = False


class PtyFaults(SerialFaults):
    """The same of a light at a real port, which has another name when it is plugged in again."""

    def __init__(self, device: Any) -> None:
        super().__init__(device)
        self.server = PtyServer(device)

    def unplug(self) -> None:
        self.server.unplug()

    def plug_in(self) -> None:
        super().plug_in()
        self.server = PtyServer(self.device)


class ScriptedPort:
    """Expects exactly these bytes, one write after another, and answers with those."""

    def __init__(self, script: list[tuple[bytes, bytes]], clock: ManualClock) -> None:
        self._script, self._clock = list(script), clock
        self._came = b""

    @property
    def in_waiting(self) -> int:
        return len(self._came)

    def read(self, size: int, /) -> bytes:
        if not self._came:
            self._clock.sleep(0.02)
        data, self._came = self._came[:size], self._came[size:]
        return data

    def write(self, data: bytes, /) -> int:
        assert self._script, f"nothing more was expected, but {data!r} came"
        expected, answer = self._script.pop(0)
        assert data == expected
        self._came += answer
        return len(data)

    def close(self) -> None:
        pass

    def is_done(self) -> bool:
        return not self._script

    def opener(self, seen: dict[str, Any]) -> Callable[..., ScriptedPort]:
        """A stand-in for `serial.Serial` that notes how it was opened."""

        def open_port(port: str, **settings: object) -> ScriptedPort:
            seen.update(settings, port=port)
            return self

        return open_port


class SerialStorm(LightStorm):
    """The faults of a serial line."""

    device: LineDevice

    def faults(self) -> st.SearchStrategy[LineFault]:
        return st.builds(LineFault, st.sampled_from(get_args(FaultKind)), st.sampled_from([0.45, 0.55, 0.8, 1.2, 2.2]))

    def happen(self, fault: LineFault) -> None:
        self.device.faults.append(fault)

    def is_calm(self) -> bool:
        return not self.device.faults and not self.device.is_unplugged

    def recover(self) -> None:
        super().recover()
        self.device.is_unplugged = False
