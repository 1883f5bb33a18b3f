"""What is done with the devices step by step: averages of frames, the dark, the reference.

Nothing here knows threads or windows; whoever calls owns the devices. Each routine leaves camera, light and stage as
it found them, also when it is cancelled.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from app.devices import Devices
from drivers.interface import Camera, DeviceTimeout, Frame, FrameLost

Progress = Callable[[Frame, float], None]  # the frame that has come, and how much is done, 0 ... 1
ShouldStop = Callable[[], bool]

WAIT_SLICE_S = 0.1  # no wait is longer, so that a stop takes effect at once even in a long exposure
_MARGIN_S = 3.0  # beyond the exposure, before a missing frame counts as a fault


class Cancelled(Exception):
    """Somebody asked the routine to stop."""


@dataclass(frozen=True, slots=True, eq=False)
class Average:
    """The mean of some frames, with what they were taken with."""

    mean: NDArray[np.float32]  # counts, (row, column)
    variance: NDArray[np.float32]  # of a single frame, counts^2, (row, column); zero for one frame
    frames: int
    exposure_s: float
    em_gain: float
    amplifier: str


def next_frame(camera: Camera, should_stop: ShouldStop) -> Frame:
    """Wait for the next frame in slices; raise `Cancelled` when asked to stop, `DeviceTimeout` when none comes.

    One that was lost on its way is passed over: the gap in the numbers tells of it.
    """
    deadline_s = time.monotonic() + camera.exposure_s + _MARGIN_S
    while True:
        if should_stop():
            raise Cancelled
        try:
            return camera.read(WAIT_SLICE_S)
        except DeviceTimeout:
            if time.monotonic() > deadline_s:
                raise
        except FrameLost as error:
            if time.monotonic() > deadline_s:
                raise DeviceTimeout(f"no whole frame has come for long: {error}") from error


def average(camera: Camera, frames: int, *, progress: Progress, should_stop: ShouldStop) -> Average:
    """Restart the camera, so that no frame from before counts, and average `frames` frames."""
    camera.stop()
    camera.start()
    shape = (camera.capabilities.rows, camera.capabilities.columns)
    total, squares = np.zeros((2, *shape))
    for index in range(frames):
        frame = next_frame(camera, should_stop)
        pixels = frame.pixels.astype(np.float64)
        total += pixels
        squares += pixels**2
        progress(frame, (index + 1) / frames)
    mean = total / frames
    variance = np.maximum(squares / frames - mean**2, 0) * frames / max(frames - 1, 1)
    return Average(
        mean=mean.astype(np.float32),
        variance=variance.astype(np.float32),
        frames=frames,
        exposure_s=camera.exposure_s,
        em_gain=camera.em_gain,
        amplifier=camera.amplifier,
    )


def take_dark(devices: Devices, frames: int, *, progress: Progress, should_stop: ShouldStop) -> Average:
    """Average frames with the light off."""
    with _light_and_sample(devices, light_on=False, sample_in=devices.stage.is_sample_in):
        return average(devices.camera, frames, progress=progress, should_stop=should_stop)


def take_reference(devices: Devices, frames: int, *, progress: Progress, should_stop: ShouldStop) -> Average:
    """Average frames with the light on and the sample out."""
    with _light_and_sample(devices, light_on=True, sample_in=False):
        return average(devices.camera, frames, progress=progress, should_stop=should_stop)


@contextmanager
def _light_and_sample(devices: Devices, *, light_on: bool, sample_in: bool) -> Iterator[None]:
    """Switch light and stage for a while, then put them, and a running camera, back as they were."""
    before = (devices.light.is_on, devices.stage.is_sample_in, devices.camera.is_running)

    def restore() -> None:
        devices.camera.stop()
        devices.stage.set_sample_in(before[1])
        devices.light.set_on(before[0])
        if before[2]:
            devices.camera.start()

    try:
        devices.light.set_on(light_on)
        devices.stage.set_sample_in(sample_in)
        yield
    except Cancelled:
        restore()
        raise
    restore()  # after a fault nothing is restored: whoever owns the devices closes them, the light first
