"""Counts of a frame: their statistics, a profile along a line, and those in a rectangle."""

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from reconstruction.arrays import Floats
from reconstruction.frame.pixels import is_piled_up
from reconstruction.geometry import Field, Sensor
from reconstruction.runtime.compilation import compiled

NEARLY_FULL = 0.95  # of the level at which pixels clip
Selection = tuple[Literal["line", "area"], tuple[float, float], tuple[float, float]]  # ends or corners (x, y), px
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


def profile(
    pixels: NDArray[np.integer[Any]], start_px: tuple[float, float], end_px: tuple[float, float]
) -> tuple[Floats, Floats]:
    """Return distances along a line between two points (x, y), at most 1 px apart, and the counts there.

    Counts are interpolated linearly between the pixels (row, column); NaN outside them.
    """
    length_px = math.dist(start_px, end_px)
    along = np.linspace(0, 1, math.ceil(length_px) + 1)
    x, y = (first + along * (last - first) for first, last in zip(start_px, end_px, strict=True))
    counts = map_coordinates(pixels, [y, x], output=np.float64, order=1, mode="constant", cval=np.nan)
    return along * length_px, counts


def lengths_of(length_px: float, sensor: Sensor, field: Field) -> tuple[float, float, float]:
    """Return a length on the camera in m, as an angle within a subimage in rad, and at the source in m."""
    length_m = length_px * sensor.pixel_pitch_m
    angle_rad = length_m / sensor.lenslet_focal_length_m
    return length_m, angle_rad, angle_rad * field.collimator_focal_length_m


@dataclass(frozen=True, slots=True)
class AreaStatistics:
    """Statistics of the counts in a rectangle."""

    rows: int
    columns: int
    mean: float
    sigma: float
    lowest: int
    highest: int
    clipped: int  # number of pixels


MeasuredPart = tuple[Floats, Floats] | AreaStatistics | None  # a profile, an area, or neither


def area_statistics(
    pixels: NDArray[np.integer[Any]], x_px: tuple[float, float], y_px: tuple[float, float], clip_level: float = math.inf
) -> AreaStatistics | None:
    """Return the statistics of the pixels (row, column) in a rectangle; None if there are none.

    A pixel on an edge lies in it, and is clipped from `clip_level` on.
    """
    first_row, first_column = (max(math.ceil(low), 0) for low, _ in (y_px, x_px))
    inside = pixels[first_row : max(math.floor(y_px[1]) + 1, 0), first_column : max(math.floor(x_px[1]) + 1, 0)]
    if not inside.size:
        return None
    rows, columns = inside.shape
    clipped = int(np.count_nonzero(inside >= clip_level))
    mean, sigma, lowest, highest = (float(f(inside)) for f in (np.mean, np.std, np.min, np.max))
    return AreaStatistics(rows, columns, mean, sigma, int(lowest), int(highest), clipped)


def frame_counts(
    pixels: NDArray[np.integer[Any]], full_scale: int, selection: Selection | None
) -> tuple[FrameStatistics, MeasuredPart]:
    """Return the statistics of a frame, and the profile or the statistics of a selection."""
    found = frame_statistics(pixels, full_scale)
    if selection is None:
        return found, None
    kind, start_px, end_px = selection
    if kind == "line":
        return found, profile(pixels, start_px, end_px)
    x_px, y_px = zip(start_px, end_px, strict=True)
    return found, area_statistics(pixels, x_px, y_px, found.clip_level)
