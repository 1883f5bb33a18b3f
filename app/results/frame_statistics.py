"""Statistics of a camera frame: histogram, brightest pixel, and pixels that are clipped."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import Floats
from reconstruction.quality.clipping import is_piled_up
from reconstruction.runtime.compilation import compiled

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
    if pixels.dtype.kind != "u":
        raise ValueError(f"{pixels.dtype} may be negative: no counts of a camera")
    peak = int(pixels.max())
    top = full_scale or peak
    edges = _edges(max(top, peak) + 1)
    by_count = np.zeros(edges[-1], np.intp)
    _count(np.ascontiguousarray(pixels), by_count)
    of_bins = np.add.reduceat(by_count, edges[:-1])
    clip_level = _clip_level(by_count, peak, full_scale) if full_scale else peak + 1
    share = float(by_count[clip_level:].sum() / pixels.size)
    return FrameStatistics(edges.astype(np.float64), of_bins, peak, clip_level, share)


@compiled
def _count(pixels: NDArray[np.integer[Any]], by_count: NDArray[np.intp]) -> None:
    """Count the pixels (row, column) with each count."""
    for row in range(pixels.shape[0]):
        for column in range(pixels.shape[1]):
            by_count[pixels[row, column]] += 1


@lru_cache(maxsize=4)
def _edges(end: int) -> NDArray[np.intp]:
    """Lower edges of the bins from 0 to an end, and the end."""
    return np.unique(np.linspace(0, end, _BINS + 1).astype(np.intp))


def _clip_level(by_count: NDArray[np.intp], peak: int, full_scale: int) -> int:
    """Count from which pixels are clipped, from the number with each count; full scale if no full well shows."""
    if peak >= full_scale:
        return full_scale
    lowest = peak - max(round(_STEP * peak), 1) + 1
    piled, below = by_count[lowest : peak + 1].sum(), by_count[max(2 * lowest - peak - 1, 0) : lowest].sum()
    is_full_well = is_piled_up(int(piled), int(below)) and _LEAST_SHARE < piled / by_count.sum() < _MOST_SHARE
    return lowest if is_full_well else full_scale
