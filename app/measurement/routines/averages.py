"""Averages of frames: the dark and the reference."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from app.measurement.routines.device_state import restored
from app.measurement.routines.frames import FrameProgress, ShouldStop, next_frame
from app.progress import counted
from drivers.interface import BadValue, Camera, Devices

AVERAGED_FRAMES = range(1, 10_001)  # allowed numbers


@dataclass(frozen=True, slots=True, eq=False)
class Average:
    """Mean and variance of some frames, with their camera settings."""

    mean: NDArray[np.float32]  # counts, (row, column)
    variance: NDArray[np.float32]  # of a single frame, counts^2, (row, column); zero for one frame
    frames: int
    exposure_s: float
    em_gain: float
    amplifier: str


def average(camera: Camera, frames: int, *, progress: FrameProgress, should_stop: ShouldStop) -> Average:
    """Restart the camera, to exclude earlier frames, and average `frames` frames.

    Recurrence of B. P. Welford (Technometrics 4, 419, 1962), which avoids cancellation.
    """
    _check(frames)
    camera.stop()
    camera.start()
    capabilities = camera.capabilities
    mean, squares = np.zeros((2, capabilities.rows, capabilities.columns))
    for index in range(frames):
        frame = next_frame(camera, should_stop)
        away = frame.pixels - mean
        mean += away / (index + 1)
        squares += away * (frame.pixels - mean)
        progress(frame, (index + 1) / frames)
    return Average(
        mean=mean.astype(np.float32),
        variance=(squares / max(frames - 1, 1)).astype(np.float32),
        frames=frames,
        exposure_s=camera.exposure_s,
        em_gain=camera.em_gain,
        amplifier=camera.amplifier,
    )


def take_dark(devices: Devices, frames: int, *, progress: FrameProgress, should_stop: ShouldStop) -> Average:
    """Average frames with the light off."""
    _check(frames)
    with restored(devices):
        devices.light.set_on(False)
        return average(devices.camera, frames, progress=progress, should_stop=should_stop)


def take_reference(devices: Devices, frames: int, *, progress: FrameProgress, should_stop: ShouldStop) -> Average:
    """Average frames with the light on and the sample out."""
    _check(frames)
    with restored(devices):
        devices.stage.set_sample_in(False)
        devices.light.set_on(True)
        return average(devices.camera, frames, progress=progress, should_stop=should_stop)


def _check(frames: int) -> None:
    if frames not in AVERAGED_FRAMES:
        raise BadValue(f"{counted(frames)} cannot be averaged: {AVERAGED_FRAMES.start} ... {AVERAGED_FRAMES[-1]} can")
