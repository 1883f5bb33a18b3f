"""Statistics of a camera frame: histogram, brightest pixel, and pixels that are clipped."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import Floats
from reconstruction.quality.clipping import clip_level

NEARLY_FULL = 0.95  # of the level at which pixels clip
_BINS = 128
_STEP = 2e-3  # of the highest count: scatter of clipped pixels, by read noise
_LEAST_SHARE, _MOST_SHARE = 2e-4, 0.5  # of the pixels, that a full well clips; of more, nothing is known


@dataclass(frozen=True, slots=True, eq=False)
class FrameStatistics:
    """Statistics of the counts of one frame."""

    level: Floats  # lower edge of each bin, and the upper edge of the last, counts, (bin + 1,)
    pixels: NDArray[np.intp]  # number in each bin, (bin,)
    peak: int  # highest count
    clip_level: int  # count from which pixels are clipped: full scale, or a full well that shows below it
    clipped_share: float  # of the pixels

    @property
    def is_nearly_full(self) -> bool:
        """True from 95 % of the level at which pixels clip."""
        return self.peak >= NEARLY_FULL * self.clip_level


def frame_statistics(pixels: NDArray[np.integer[Any]], full_scale: int) -> FrameStatistics:
    """Count the pixels (row, column) of a frame in bins from 0 to full scale.

    A full well below full scale shows by many pixels at the highest count and few just below. Full scale 0 is unknown:
    then the bins end at the highest count, and nothing is clipped.
    """
    by_count = np.bincount(pixels.ravel(), minlength=1)
    peak = len(by_count) - 1
    top = full_scale or peak
    edges = np.unique(np.linspace(0, max(top, peak) + 1, _BINS + 1).astype(np.intp))
    of_bins = np.add.reduceat(np.append(by_count, np.zeros(edges[-1] - len(by_count), by_count.dtype)), edges[:-1])
    clip_level = _clip_level(pixels, peak, full_scale) if full_scale else peak + 1
    share = float(by_count[clip_level:].sum() / pixels.size)
    return FrameStatistics(edges.astype(np.float64), of_bins, peak, clip_level, share)


def _clip_level(pixels: NDArray[np.integer[Any]], peak: int, full_scale: int) -> int:
    if peak >= full_scale:
        return full_scale
    level = clip_level(pixels, max(round(_STEP * peak), 1))
    if level is None:
        return full_scale
    lowest = math.floor(level) + 1
    return lowest if _LEAST_SHARE < np.count_nonzero(pixels >= lowest) / pixels.size < _MOST_SHARE else full_scale
