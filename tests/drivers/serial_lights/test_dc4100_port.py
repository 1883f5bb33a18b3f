"""DC4100 driver on serial ports: pseudo-terminal, open errors, interpreter exit."""

from __future__ import annotations

import errno
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import serial
from support.light_contract import LightFaultContract
from support.patience import own_time
from support.serial_stand_in import PtyFaults, patient_wire
from support.stand_ins.dc4100 import DC4100Wire
from support.stand_ins.pseudo_terminal import PtyServer
from support.stand_ins.serial import LineFault

from drivers.errors import Busy, DeviceError, Disconnected
from drivers.serial_lights import DC4100Settings
from drivers.serial_lights._line import Wire
from drivers.serial_lights.thorlabs_dc4100 import ThorlabsDC4100


@pytest.mark.posix
class TestContractOnAPort(LightFaultContract):
    @pytest.fixture
    def faults(self) -> Iterator[PtyFaults]:
        device = DC4100Wire()
        device.heads[0].is_on = True  # left on
        faults = PtyFaults(device)
        yield faults
        faults.server.close()

    @pytest.fixture
    def reopen(self, faults: PtyFaults) -> Callable[[], ThorlabsDC4100]:
        return lambda: ThorlabsDC4100(DC4100Settings(port=faults.server.port), wire=faults.wire)


@pytest.mark.posix
def test_unplugged_port_between_commands_raises() -> None:
    with PtyServer(DC4100Wire()) as server:
        light = ThorlabsDC4100(DC4100Settings(port=server.port), wire=patient_wire(server))
        server.unplug()
        with own_time() as elapsed_s:
            with pytest.raises(Disconnected):
                light.set_on(True)
            assert elapsed_s() < 2
        light.close()


@pytest.mark.posix
def test_unplugged_port_during_command_reopens_when_plugged_in() -> None:
    device = DC4100Wire()
    with PtyServer(device) as server:
        light = ThorlabsDC4100(DC4100Settings(port=server.port), wire=patient_wire(server))
        device.faults.append(LineFault("unplug"))
        with pytest.raises(Disconnected):
            _ = light.current_a
        light.close()
    device.is_unplugged = False
    with (
        PtyServer(device) as server,
        ThorlabsDC4100(DC4100Settings(port=server.port), wire=patient_wire(server)) as light,
    ):
        light.set_on(True)
        assert device.is_lit
    assert not device.is_lit


@pytest.mark.posix
def test_port_held_by_other_program_is_busy() -> None:
    with (
        PtyServer(DC4100Wire()) as server,
        serial.Serial(server.port, exclusive=True),
        pytest.raises(Busy, match=f"another program holds {server.port}"),
    ):
        ThorlabsDC4100(DC4100Settings(port=server.port))


def test_missing_port_is_reported() -> None:
    with pytest.raises(Disconnected, match="there is no /dev/ttyNone"):
        ThorlabsDC4100(DC4100Settings(port="/dev/ttyNone"))
    with pytest.raises(DeviceError, match="cannot be opened as a serial port"):
        ThorlabsDC4100(DC4100Settings(port=__file__))


@pytest.mark.parametrize(
    ("error", "kind", "words"),
    [
        (serial.SerialException(errno.EACCES, "[Errno 13] Permission denied"), DeviceError, "dialout"),
        (serial.SerialException(errno.EBUSY, "Device or resource busy"), Busy, "another program"),
        (serial.SerialException("could not open port 'COM7': PermissionError(13, 'Denied')"), Busy, "another program"),
        (serial.SerialException("could not open port 'COM7': FileNotFoundError(2, 'x')"), Disconnected, "no COM7"),
    ],
)
def test_open_error_states_reason(error: Exception, kind: type[DeviceError], words: str) -> None:
    def open_port(_port: str, **_settings: object) -> Any:
        raise error

    with pytest.raises(kind, match=words):
        ThorlabsDC4100(DC4100Settings(port="COM7"), wire=Wire(open_port=open_port))


LEAVING = """
import signal, sys
from dataclasses import replace
from drivers.serial_lights import thorlabs_dc4100
from drivers.serial_lights import DC4100Settings
from drivers.serial_lights.thorlabs_dc4100 import ThorlabsDC4100
thorlabs_dc4100._DIALECT = replace(thorlabs_dc4100._DIALECT, timeout_s=60.0)
signal.signal(signal.SIGINT, signal.default_int_handler)  # even if the tests ignore it
light = ThorlabsDC4100(DC4100Settings(port=sys.argv[1]))
light.set_on(True)
assert light.is_on
print("lit", flush=True)
sys.stdin.readline()
{ending}
"""


WITHOUT_DEL = "from drivers.light_source import LightSource; del LightSource.__del__"


@pytest.mark.posix
@pytest.mark.parametrize("ending", ["sys.exit(3)", "raise RuntimeError", "del light", "while True: pass", WITHOUT_DEL])
def test_light_goes_off_at_interpreter_exit(ending: str) -> None:
    device = DC4100Wire()
    with PtyServer(device) as server:
        program = subprocess.Popen(  # noqa: S603 - our own interpreter
            [sys.executable, "-c", LEAVING.format(ending=ending), server.port],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        with program:
            assert program.stdout is not None
            assert program.stdout.readline() == "lit\n"
            assert device.is_lit
            assert program.stdin is not None
            program.stdin.write("\n")
            program.stdin.flush()
            if ending.startswith("while"):
                time.sleep(0.2)
                program.send_signal(signal.SIGINT)  # Ctrl-C
        assert not device.is_lit
