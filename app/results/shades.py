"""Pixels of pictures: counts between a black and a white level, and maps enlarged."""

from typing import Any, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from reconstruction.runtime.compilation import compiled

Pixels: TypeAlias = NDArray[np.uint32]  # 0xAARRGGBB; 0 is transparent


def shaded(counts: NDArray[np.integer[Any]], black: float, white: float, table: Pixels) -> Pixels:
    """Colour of each pixel (row, column): the table's first at the black level and below, its last at the white one."""
    found = np.empty(counts.shape, np.uint32)
    last = np.float32(len(table) - 1)
    _fill(np.ascontiguousarray(counts), np.float32(black), last / np.float32(white - black), table, found)
    return found


def enlarged(maps: Pixels, rows: int, columns: int, *, is_smooth: bool) -> Pixels:
    """Enlarge each map (view_row, view_column, row, column), by linear interpolation if smooth.

    Qt would do it in threads of its own, and keep Python's lock until they end.
    """
    maps = np.ascontiguousarray(maps)
    found = np.empty((*maps.shape[:2], rows, columns), np.uint32)
    how = cv2.INTER_LINEAR if is_smooth else cv2.INTER_NEAREST_EXACT
    for view in np.ndindex(maps.shape[:2]):
        small, large = (each[view][..., None].view(np.uint8) for each in (maps, found))
        cv2.resize(small, (columns, rows), dst=large, interpolation=how)
    return found


@compiled
def _fill(
    counts: NDArray[np.integer[Any]], black: np.float32, per_count: np.float32, table: Pixels, found: Pixels
) -> None:
    last = np.float32(table.size - 1)
    for row in range(counts.shape[0]):
        for column in range(counts.shape[1]):
            place = (np.float32(counts[row, column]) - black) * per_count
            found[row, column] = table[np.int32(min(max(place, np.float32(0)), last) + np.float32(0.5))]
