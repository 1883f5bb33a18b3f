"""The simulated devices in storms of commands and faults."""

from __future__ import annotations

import functools
import tempfile
from pathlib import Path
from typing import Any

from hypothesis import strategies as st
from support.camera_storm import CameraStorm
from support.light_storm import LightStorm
from support.simulated_scene import SimulatedCameraFaults, SimulatedLightFaults, is_calm, open_bench
from support.storm import storm_settings

from drivers.interface import Camera, LightSource
from simulated_devices.bench import SimulatedBench, SimulatedLight
from simulated_devices.camera import SimulatedCamera

LIMIT_A = 0.6  # below the head's 1 A


@functools.cache
def bench() -> SimulatedBench:
    """One bench for all sequences: it is the devices that are opened anew."""
    with tempfile.TemporaryDirectory() as folder:
        return open_bench(Path(folder))


class SimulatedCameraStorm(CameraStorm):
    def make(self) -> SimulatedBench:
        return bench()

    def open(self) -> Camera:
        camera = SimulatedCamera(self.device)
        self.hand = SimulatedCameraFaults(camera)
        return camera

    def now(self) -> float:
        return float(self.device.clock.now())

    def faults(self) -> st.SearchStrategy[Any]:
        return st.sampled_from(["unplug", "stall", "refuse_next"]) | st.integers(1, 20)

    def happen(self, fault: Any) -> None:
        if isinstance(fault, int):
            self.hand.lose_frames(fault)
        else:
            getattr(self.hand, fault)()

    def recover(self) -> None:
        """Nothing to do: a new camera is plugged in."""


class Lamp:
    """Light of the bench and its state as an observer sees it."""

    def __init__(self) -> None:
        self.bench = bench()
        self.light: SimulatedLight | None = None

    @property
    def is_lit(self) -> bool:
        return self.bench.condition.is_light_on


class SimulatedLightStorm(LightStorm):
    def make(self) -> Lamp:
        return Lamp()

    def open(self) -> LightSource:
        light = SimulatedLight(self.device.bench, limit_a=LIMIT_A)
        self.device.light = light
        return light

    def true_current_a(self) -> float:
        return float(self.device.bench.condition.current_a)

    def true_maximum_a(self) -> float:
        return LIMIT_A

    def faults(self) -> st.SearchStrategy[Any]:
        return st.sampled_from(["unplug", "refuse_next", "fail_next"])

    def happen(self, fault: Any) -> None:
        getattr(SimulatedLightFaults(self.device.bench, self.device.light), fault)()

    def is_calm(self) -> bool:
        return is_calm(self.device.light)

    def recover(self) -> None:
        """Nothing to do: a new light is plugged in."""


TestSimulatedCamera = SimulatedCameraStorm.TestCase
TestSimulatedCamera.settings = storm_settings()
TestSimulatedLight = SimulatedLightStorm.TestCase
TestSimulatedLight.settings = storm_settings()
