"""Leaving the devices as they were found."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass

from drivers.interface import REFUSALS, DeviceError, Devices


@dataclass(slots=True)
class Found:
    """How the devices stood; what a routine changes here is how it leaves them instead."""

    is_light_on: bool
    current_a: float
    is_sample_in: bool
    is_running: bool
    exposure_s: float

    @classmethod
    def of(cls, devices: Devices) -> Found:
        """Ask the devices."""
        camera, light, stage = devices.camera, devices.light, devices.stage
        return cls(light.is_on, light.current_a, stage.is_sample_in, camera.is_running, camera.exposure_s)

    def restore(self, devices: Devices) -> None:
        """Put the devices back; the light goes off before anything moves, and on again after."""
        camera, light, stage = devices.camera, devices.light, devices.stage
        if not self.is_light_on:
            light.set_on(False)
        camera.stop()
        if stage.is_sample_in != self.is_sample_in:
            stage.set_sample_in(self.is_sample_in)
        if light.current_a != self.current_a:
            light.set_current(self.current_a)
        if self.is_light_on:
            light.set_on(True)
        if camera.exposure_s != self.exposure_s:
            camera.set_exposure(self.exposure_s)
        if self.is_running:
            camera.start()


@contextmanager
def as_found(devices: Devices) -> Iterator[Found]:
    """Put light, current, stage, exposure and a running camera back as they were, however it ends.

    Not after a fault of a device: then the light goes off at once, and whoever owns the devices closes them.
    """
    is_restored = False
    try:
        found = Found.of(devices)
        try:
            yield found
        except BaseException as error:
            if not isinstance(error, DeviceError) or isinstance(error, REFUSALS):
                found.restore(devices)
                is_restored = True
            raise
        found.restore(devices)
        is_restored = True
    finally:
        if not is_restored:
            with suppress(DeviceError):  # it may be the light itself that has failed
                devices.light.set_on(False)
