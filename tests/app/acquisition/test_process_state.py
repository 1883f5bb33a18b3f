"""State of the processes that an instrument has started."""

from __future__ import annotations

import signal
import subprocess
import sys

import pytest
from support.gui_bench import BENCH, FakeCamera
from support.patience import wait_until
from support.wires.dc4100 import DC4100Wire
from support.wires.pseudo_terminal import PtyServer

from app.acquisition.guarded_light import GuardedLight
from app.acquisition.instrument import Instrument
from app.acquisition.process_state import Condition, ProcessState
from drivers.interface import Devices
from drivers.serial_lights import DC4100Settings

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="elsewhere nobody tells that a process was stopped")


def test_process_is_alive_frozen_or_gone() -> None:
    with subprocess.Popen(["sleep", "600"]) as process:  # noqa: S607 - of every system

        def has(condition: Condition) -> bool:
            return ProcessState.of("finder", process) == ProcessState("finder", process.pid, condition)

        assert has("alive")
        process.send_signal(signal.SIGSTOP)
        wait_until(lambda: has("frozen"))
        process.send_signal(signal.SIGCONT)
        wait_until(lambda: has("alive"))
        process.kill()
        wait_until(lambda: has("gone"))


def test_instrument_knows_the_guardian_of_its_light() -> None:
    with PtyServer(DC4100Wire()) as server, GuardedLight(DC4100Settings(port=server.port)) as light:
        camera = FakeCamera()
        instrument = Instrument(Devices(camera, light, camera.stage), BENCH)
        (guardian,) = instrument.processes()
        assert guardian == ProcessState("guardian", light.guardian.pid, "alive")
        light.guardian.kill()
        wait_until(lambda: instrument.processes()[0].condition == "gone")
