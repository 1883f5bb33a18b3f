"""Frames whose average is one that was kept: what a recording shows in place of its dark and its reference."""

from __future__ import annotations

from math import sqrt

import numpy as np
from numpy.typing import NDArray

from app.measurement.routines.averages import Average
from reconstruction.arrays import Floats

_ROUNDING = 1 / 6  # counts^2, of a difference between two numbers that are rounded each


class AveragedFrames:
    """As many frames as were averaged, again and again: their mean is exact, their variance nearly."""

    def __init__(self, average: Average, full_scale: int) -> None:
        """Prepare what every pixel does: it goes up and down by its spread, never beyond 0 and `full_scale`."""
        self._frames, self._spread = average.frames, _spread(average, full_scale)
        self._sum = np.rint(average.mean.astype(np.float64) * average.frames)
        rng, shape = np.random.default_rng(0), average.mean.shape  # so that pixels do not go up together
        self._first = rng.integers(self._frames, size=shape)
        self._remainder = rng.random(shape, np.float32)  # count, so that no rounding goes with the ups and downs

    def pixels(self, index: int) -> NDArray[np.uint16]:
        """Return frame number `index` (row, column), counts, read-only."""
        step = (self._first + index) % self._frames
        pixels = (self._total(step + 1) - self._total(step)).astype(np.uint16)
        pixels.flags.writeable = False
        return pixels

    def _total(self, frames: NDArray[np.int64]) -> Floats:
        """Sum of each pixel's first frames, counts: whole numbers, so that no rounding adds up."""
        is_up = (frames % 2 == 1) & (frames < self._frames)
        total: Floats = np.floor(frames * self._sum / self._frames + is_up * self._spread + self._remainder)
        return total


def _spread(average: Average, full_scale: int) -> Floats:
    """How far each pixel goes up and down, counts: as far as its variance says, and as it can by whole counts."""
    pairs, mean = average.frames // 2, average.mean.astype(np.float64)
    scale = sqrt((average.frames - 1) / (2 * pairs)) if pairs else 0.0
    wanted = scale * np.sqrt(np.maximum(average.variance.astype(np.float64) - _ROUNDING, 0))
    room = np.floor(np.minimum(mean, full_scale - mean))
    spread: Floats = np.clip(wanted, 0, np.maximum(room, 0))
    return spread
