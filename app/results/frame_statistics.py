"""Statistics of the counts of a frame."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import Floats
from reconstruction.frame.pixels import is_piled_up
from reconstruction.runtime.compilation import compiled

NEARLY_FULL = 0.95  # of the level at which pixels clip
_BINS = 128  # of the histogram
_STEP = 2e-3  # of the highest count: scatter of clipped pixels, by read noise
_USUAL = 0.01, 0.998  # shares of the pixels, from the darkest on, that the usual counts lie between
_LEAST_SHARE, _MOST_SHARE = 2e-4, 0.5  # of the pixels, that a full well clips; of more, nothing is known


@dataclass(frozen=True, slots=True, eq=False)
class FrameStatistics:
    """Statistics of the counts of one frame."""

    level: Floats  # lower edge of each bin, and the upper edge of the last, counts, (bin + 1,)
    pixels: NDArray[np.intp]  # number in each bin, (bin,)
    peak: int  # highest count
    clip_level: int  # count from which pixels are clipped: full scale, or a full well that shows below it
    clipped_share: float  # of the pixels
    usual: tuple[int, int]  # counts that all but the darkest 1 % and the brightest 0.2 % of the pixels lie between

    @property
    def is_nearly_full(self) -> bool:
        """True from `NEARLY_FULL` of the level at which pixels clip."""
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
    edges = np.unique(np.linspace(0, max(top, peak) + 1, _BINS + 1).astype(np.intp))
    by_count = np.zeros(edges[-1], np.intp)
    _count(np.ascontiguousarray(pixels), by_count)
    of_bins = np.add.reduceat(by_count, edges[:-1])
    clip_level = _clip_level(by_count, peak, full_scale) if full_scale else peak + 1
    share = float(by_count[clip_level:].sum() / pixels.size)
    low, high = np.searchsorted(by_count.cumsum(), np.array(_USUAL) * pixels.size)
    return FrameStatistics(edges.astype(np.float64), of_bins, peak, clip_level, share, (int(low), int(high)))


@compiled
def _count(pixels: NDArray[np.integer[Any]], by_count: NDArray[np.intp]) -> None:
    for row in range(pixels.shape[0]):
        for column in range(pixels.shape[1]):
            by_count[pixels[row, column]] += 1


def _clip_level(by_count: NDArray[np.intp], peak: int, full_scale: int) -> int:
    """Count from which pixels are clipped, of a histogram; full scale if no full well shows."""
    if peak >= full_scale:
        return full_scale
    lowest = peak - max(round(_STEP * peak), 1) + 1
    piled, below = by_count[lowest : peak + 1].sum(), by_count[max(2 * lowest - peak - 1, 0) : lowest].sum()
    is_full_well = is_piled_up(int(piled), int(below)) and _LEAST_SHARE < piled / by_count.sum() < _MOST_SHARE
    return lowest if is_full_well else full_scale
