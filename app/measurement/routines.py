"""Parts of all routines: waits for frames, early ends, states of devices.

Routines run in the thread that owns the devices. Each restores camera, light and stage, also when it is cancelled or
fails; after a device fault it turns the light off.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass

import numpy as np

from app.errors import RunError
from drivers.interface import (
    REFUSALS,
    Camera,
    DeviceError,
    Devices,
    DeviceTimeout,
    Frame,
    FrameLost,
    LightHeldOff,
    LightSource,
    Region,
)

FrameProgress = Callable[[Frame, float], None]  # newest frame, fraction done 0 ... 1
ShouldStop = Callable[[], bool]


@dataclass(frozen=True, slots=True)
class RoutineCallbacks:
    """Callbacks of a routine; by default nobody watches."""

    progress: FrameProgress = lambda *_: None
    should_stop: ShouldStop = lambda: False


NO_CALLBACKS = RoutineCallbacks()

_SLICE_S = 0.005  # longest wait for a frame: commands and a stop take effect at once even in a long exposure
_MARGIN_S = 3.0  # timeout beyond the exposure
_LONGEST_TURN_S = 0.1  # that counts of one slice: in a longer one this process was stopped
_SAME_EXPOSURE = 1e-3  # relative


class Cancelled(Exception):
    """The routine was asked to stop."""


class RoutineError(RunError):
    """A routine cannot reach its goal, although no device failed; the text says what to do."""


def next_frame(camera: Camera, should_stop: ShouldStop) -> Frame:
    """Wait for the next frame, lost ones skipped; `Cancelled` on a stop, `DeviceTimeout` if none arrives."""
    left_s, before_s = camera.exposure_s + _MARGIN_S, time.monotonic()
    while True:
        if should_stop():
            raise Cancelled
        try:
            return camera.read(_SLICE_S)
        except (DeviceTimeout, FrameLost) as error:
            now_s = time.monotonic()
            left_s -= min(now_s - before_s, _LONGEST_TURN_S)
            before_s = now_s
            if left_s < 0 and isinstance(error, FrameLost):
                raise DeviceTimeout(f"no complete frame has arrived for too long: {error}") from error
            if left_s < 0:
                raise


def check_lit(light: LightSource) -> None:
    """Raise `RoutineError` if the light went off during a routine that needs it: the frames are dark."""
    if not light.is_on:
        raise RoutineError(f"{light.off_reason or 'the light is off'}: switch it on (L) and repeat")


@dataclass(slots=True)
class DeviceState:
    """State to which a routine restores the devices; the routine may change it."""

    is_light_on: bool
    current_a: float
    is_sample_in: bool
    is_running: bool
    exposure_s: float

    @classmethod
    def of(cls, devices: Devices) -> DeviceState:
        """Query the devices."""
        camera, light, stage = devices.camera, devices.light, devices.stage
        return cls(light.is_on, light.current_a, stage.is_sample_in, camera.is_running, camera.exposure_s)

    def restore(self, devices: Devices) -> None:
        """Restore the devices; the light goes off before anything moves, and on afterwards if it still may."""
        camera, light, stage = devices.camera, devices.light, devices.stage
        if not self.is_light_on:
            light.set_on(False)
        camera.stop()
        if stage.is_sample_in != self.is_sample_in:
            stage.set_sample_in(self.is_sample_in)
        if light.current_a != self.current_a:
            light.set_current(self.current_a)
        if self.is_light_on:
            with suppress(LightHeldOff):
                light.set_on(True)
        if camera.exposure_s != self.exposure_s:
            camera.set_exposure(self.exposure_s)
        if self.is_running:
            camera.start()


@contextmanager
def restored(devices: Devices) -> Iterator[DeviceState]:
    """Restore light, current, stage, exposure and running camera after a `with`; after a fault turn the light off."""
    is_restored = False
    try:
        state = DeviceState.of(devices)
        try:
            yield state
        except BaseException as error:
            if not isinstance(error, DeviceError) or isinstance(error, REFUSALS):
                state.restore(devices)
                is_restored = True
            raise
        state.restore(devices)
        is_restored = True
    finally:
        if not is_restored:
            with suppress(DeviceError):  # the light itself may have failed
                devices.light.set_on(False)


@dataclass(frozen=True, slots=True)
class AcquisitionSettings:
    """Settings that must agree between a dark or reference and the frames it is used for.

    The light's current is not among them: the registration is independent of brightness.
    """

    exposure_s: float
    amplifier: str
    em_gain: float
    readout_speed: int
    binning: int
    region: Region
    mask: str

    @classmethod
    def of(cls, devices: Devices) -> AcquisitionSettings:
        """Query camera and stage."""
        camera = devices.camera
        return cls(
            exposure_s=camera.exposure_s,
            amplifier=camera.amplifier,
            em_gain=camera.em_gain,
            readout_speed=camera.readout_speed,
            binning=camera.binning,
            region=camera.region,
            mask=devices.stage.mask,
        )

    def shows_same_pixels(self, now: AcquisitionSettings) -> bool:
        """True if frames show the same pixels of the sensor as now."""
        return (self.region, self.binning) == (now.region, now.binning)

    def difference(self, now: AcquisitionSettings, *, is_lit: bool) -> str:
        """Return the worst difference, as words after "was taken"; a mask matters only if `is_lit`."""
        if not self.shows_same_pixels(now):
            return "of another part of the sensor, or with another binning"
        if is_lit and self.mask != now.mask:
            return f"with the mask {self.mask}"
        if (self.amplifier, self.em_gain) != (now.amplifier, now.em_gain):
            return "with another amplifier or gain"
        if self.readout_speed != now.readout_speed:
            return f"with readout speed {self.readout_speed}"
        if not np.isclose(self.exposure_s, now.exposure_s, rtol=_SAME_EXPOSURE):
            return f"at {self.exposure_s * 1e3:.1f} ms"
        return ""
