"""Pixels and shapes of pictures: colours, enlarged maps and contours."""

import math
from typing import TypeAlias

import contourpy
import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import Floats
from reconstruction.runtime.opencv import cv2

_MOST_CONTOURS = 16

Pixels: TypeAlias = NDArray[np.uint32]  # 0xAARRGGBB; 0 is transparent


def enlarged(maps: Pixels, rows: int, columns: int, *, is_smooth: bool) -> Pixels:
    """Enlarge each map (view_row, view_column, row, column), linearly if smooth: Qt would keep Python's lock."""
    maps = np.ascontiguousarray(maps)
    found = np.empty((*maps.shape[:2], rows, columns), np.uint32)
    how = cv2.INTER_LINEAR if is_smooth else cv2.INTER_NEAREST_EXACT
    for view in np.ndindex(maps.shape[:2]):
        small, large = (each[view][..., None].view(np.uint8) for each in (maps, found))
        cv2.resize(small, (columns, rows), dst=large, interpolation=how)
    return found


def contours(values: Floats, limit: float) -> list[Floats]:
    """Return contours (point, xy), in columns and rows of a map, at up to 16 round levels; none near unknowns."""
    if min(values.shape) < 2 or not limit > 0:
        return []
    step = contour_step(limit)
    generator = contourpy.contour_generator(z=np.ma.masked_invalid(values))
    known = values[np.isfinite(values)]
    if not known.size:
        return []
    levels = np.arange(math.ceil(known.min() / step), math.floor(known.max() / step) + 1) * step
    return [np.asarray(line, np.float64) for level in levels for line in generator.lines(float(level))]


def contour_step(limit: float) -> float:
    """Return the step between contours."""
    return step_above(2 * limit / _MOST_CONTOURS, (1.0, 2.0, 5.0))


def step_above(value: float, steps: tuple[float, ...]) -> float:
    """Return the least of `steps`, which cover a decade, times a power of ten, that reaches a value."""
    decade = 10.0 ** math.floor(math.log10(value))
    return next(step * decade for step in (*steps, 10.0) if step * decade >= value * (1 - 1e-9))
