"""Averages of frames: the dark and the reference; and the check whether the dark is still good."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from app.measurement.routines import RoutineCallbacks, check_lit, next_frame, restored
from app.progress import counted
from drivers.interface import BadValue, Camera, Devices, Frame
from reconstruction.arrays import Counts

FRAMES = 20  # default number averaged into the dark, and into the reference
EXPOSURE_FRAMES = 8  # default number averaged into each exposure that measures the nonlinearity
AVERAGED_FRAMES = range(1, 10_001)  # allowed numbers
LEAST_EXPOSURE_FRAMES = 2  # of each such exposure, which tell its noise

_SIGNIFICANT = 5.0  # standard errors
_RELEVANT = 0.1  # of a dark pixel's noise in one frame; smaller drifts do not matter
_HOT_NOISES = 5.0  # pixel noises; larger changes show in every frame
_HOT_ERRORS = 7.0  # standard errors of a pixel: no false alarm among a million pixels


@dataclass(frozen=True, slots=True, eq=False, weakref_slot=True)
class Average:
    """Mean and variance of some frames, with their camera settings."""

    mean: NDArray[np.float32]  # counts, (row, column)
    variance: NDArray[np.float32]  # of a single frame, counts^2, (row, column); zero for one frame, NaN if unknown
    frames: int
    exposure_s: float
    em_gain: float
    amplifier: str

    @classmethod
    def of_image(cls, image: Counts) -> Self:
        """Copy an image (row, column), counts, as floats: differences of integers wrap. Nothing else is known of it."""
        counts: NDArray[np.float32] = image.astype(np.result_type(image, np.float32))
        return cls(counts, np.broadcast_to(np.float32(np.nan), image.shape), 1, np.nan, np.nan, "")


def average(camera: Camera, frames: int, callbacks: RoutineCallbacks) -> Average:
    """Restart the camera and average frames, by B. P. Welford's recurrence (Technometrics 4, 419, 1962)."""
    camera.stop()
    camera.start()
    mean, squares = np.zeros((2, camera.capabilities.rows, camera.capabilities.columns))
    for index in range(frames):
        frame = next_frame(camera, callbacks.should_stop)
        away = frame.pixels - mean
        mean += away / (index + 1)
        squares += away * (frame.pixels - mean)
        callbacks.progress(frame, (index + 1) / frames)
    return Average(
        mean=mean.astype(np.float32),
        variance=(squares / max(frames - 1, 1)).astype(np.float32),
        frames=frames,
        exposure_s=camera.exposure_s,
        em_gain=camera.em_gain,
        amplifier=camera.amplifier,
    )


def take_dark(devices: Devices, frames: int, callbacks: RoutineCallbacks) -> Average:
    """Average frames with the light off."""
    _check(frames)
    with restored(devices):
        devices.light.set_on(False)
        return average(devices.camera, frames, callbacks)


def take_reference(devices: Devices, frames: int, callbacks: RoutineCallbacks) -> Average:
    """Average frames with the light on and the sample out."""
    _check(frames)
    with restored(devices):
        devices.stage.set_sample_in(False)
        devices.light.set_on(True)
        averaged = average(devices.camera, frames, callbacks)
        check_lit(devices.light)
        return averaged


def _check(frames: int) -> None:
    if frames not in AVERAGED_FRAMES:
        raise BadValue(f"{counted(frames)} cannot be averaged: {AVERAGED_FRAMES.start} ... {AVERAGED_FRAMES[-1]} can")


@dataclass(frozen=True, slots=True)
class BackgroundCheck:
    """Current background compared with the dark."""

    drift_counts: float  # median over the pixels of the differences
    drift_error_counts: float  # standard error from pixel noise and from frame-to-frame jitter
    noise_counts: float  # of a pixel in one frame
    hot_pixels: int  # brighter than all others, but not in the dark
    cooled_pixels: int  # hot in the dark, but no longer
    frames: int

    @property
    def significance(self) -> float:
        """The drift in standard errors."""
        return abs(self.drift_counts) / self.drift_error_counts

    @property
    def is_good(self) -> bool:
        """True if the dark is still usable."""
        has_drifted = self.significance > _SIGNIFICANT and abs(self.drift_counts) > _RELEVANT * self.noise_counts
        return not has_drifted and self.hot_pixels == self.cooled_pixels == 0

    @property
    def verdict(self) -> str:
        """One sentence for the user."""
        drift = f"{self.drift_counts:+.2f} counts ({self.significance:.1f} standard errors)"
        pixels = f"{self.hot_pixels} new hot pixels, {self.cooled_pixels} no longer hot"
        if self.is_good:
            return f"the dark is still good: drift {drift}, no pixel has changed"
        return f"the background has changed since the dark: drift {drift}, {pixels}; take the dark again"


def check_background(devices: Devices, dark: Average, frames: int, callbacks: RoutineCallbacks) -> BackgroundCheck:
    """Compare `frames` frames without light with the dark, which must be of the same exposure and mode."""
    levels: list[float] = []

    def note(frame: Frame, fraction: float) -> None:
        levels.append(float(np.mean(frame.pixels)))
        callbacks.progress(frame, fraction)

    now = take_dark(devices, frames, RoutineCallbacks(note, callbacks.should_stop))
    return compare_backgrounds(dark, now, levels)


def compare_backgrounds(dark: Average, now: Average, levels: list[float]) -> BackgroundCheck:
    """Compare two averages without light; `levels` are the mean counts of each of the several frames of `now`."""
    difference = now.mean.astype(np.float64) - dark.mean
    drift = float(np.median(difference))
    per_frame = 1 / dark.frames + 1 / now.frames
    # Hot pixels are noisier; the scatter of few frames is uncertain, hence the common floor.
    variances = [each.variance.astype(np.float64) for each in (dark, now)]
    variance = np.average(variances, axis=0, weights=(dark.frames - 1, now.frames - 1))
    usual = max(float(np.mean(np.minimum(variance, np.percentile(variance, 99)))), 1 / 12)  # at least quantisation
    variance = np.maximum(variance, usual)
    error = np.sqrt(variance * per_frame)
    changed = np.abs(difference - drift) > np.maximum(_HOT_ERRORS * error, _HOT_NOISES * np.sqrt(usual))
    of_pixels = np.sqrt(np.pi / 2 * usual / difference.size)  # standard error of a median
    return BackgroundCheck(
        drift_counts=drift,
        drift_error_counts=float(np.sqrt(per_frame) * max(np.std(levels, ddof=1), of_pixels)),
        noise_counts=float(np.sqrt(usual)),
        hot_pixels=int(np.count_nonzero(changed & (difference > drift))),
        cooled_pixels=int(np.count_nonzero(changed & (difference < drift))),
        frames=now.frames,
    )
