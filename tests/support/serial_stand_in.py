"""Tools for tests of serial lights: ports in memory on a manual clock, faults, storms."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, get_args

import pytest
from hypothesis import strategies as st

from drivers.serial_lights._line import Wire
from simulated_devices.clock import ManualClock
from support.light_contract import LightFaultContract
from support.light_log import LightLog
from support.light_storm import LightStorm
from support.stand_ins.pseudo_terminal import PtyServer
from support.stand_ins.serial import FaultKind, LineDevice, LineFault, MemoryPort


def wire_to(device: LineDevice, clock: ManualClock) -> Wire:
    """A wire whose every port leads to the device."""
    return Wire(open_port=lambda _port, **_settings: MemoryPort(device, clock), clock=clock.now)


def patient_wire(server: PtyServer) -> Wire:
    """Ports of this computer, on a clock that stands still while the server's thread does."""
    return Wire(clock=lambda: server.idle_s)


class SerialFaults:
    """Faults of a light in memory."""

    def __init__(self, device: Any) -> None:
        self.device = device

    @property
    def log(self) -> LightLog:
        log: LightLog = self.device.log
        return log

    def fail_next(self) -> None:
        self.device.faults.append(LineFault("silence"))

    def refuse_next(self) -> None:
        self.device.refuses_next = True

    def unplug(self) -> None:
        self.device.is_unplugged = True

    def plug_in(self) -> None:
        self.device.is_unplugged = False


class SerialLightContract(LightFaultContract):
    """Contract of a light in memory; subclasses supply `device` and `reopen`."""

    @pytest.fixture
    def faults(self, device: LineDevice) -> SerialFaults:
        return SerialFaults(device)


class PtyFaults(SerialFaults):
    """Faults of a light at a pseudo-terminal, which gets a new name when plugged in again."""

    def __init__(self, device: Any) -> None:
        super().__init__(device)
        self.server = PtyServer(device)

    @property
    def wire(self) -> Wire:
        """Ports of this computer, on the clock of the present server."""
        return patient_wire(self.server)

    def unplug(self) -> None:
        self.server.unplug()

    def plug_in(self) -> None:
        super().plug_in()
        self.server = PtyServer(self.device)


class ScriptedPort:
    """A port that expects the scripted writes and returns their answers."""

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
        assert self._script, f"unexpected write of {data!r}"
        expected, answer = self._script.pop(0)
        assert data == expected
        self._came += answer
        return len(data)

    def close(self) -> None:
        pass

    def is_done(self) -> bool:
        return not self._script

    def opener(self, seen: dict[str, Any]) -> Callable[..., ScriptedPort]:
        """A replacement for `serial.Serial` that records its arguments."""

        def open_port(port: str, **settings: object) -> ScriptedPort:
            seen.update(settings, port=port)
            return self

        return open_port


class SerialStorm(LightStorm):
    """Storm of a light on a serial line."""

    device: LineDevice

    def faults(self) -> st.SearchStrategy[LineFault]:
        return st.builds(LineFault, st.sampled_from(get_args(FaultKind)), st.sampled_from([0.45, 0.55, 0.8, 1.2, 2.2]))

    def happen(self, fault: LineFault) -> None:
        self.device.faults.append(fault)

    def recover(self) -> None:
        super().recover()
        self.device.is_unplugged = False
