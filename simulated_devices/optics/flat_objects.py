"""Flat objects to photograph: a resolution target, cells, and stars; brightness (row, column), at most 1."""

import numpy as np
from scipy import ndimage

from reconstruction.arrays import Floats

_PERIODS_PX = (6, 8, 12, 16)
_STARS = 150
_CELLS = 60


def resolution_target(side: int) -> Floats:
    """Square fields of bars, horizontal and vertical in turn, with periods of 6, 8, 12 and 16 px row by row."""
    y, x = np.indices((side, side))
    cell = side // len(_PERIODS_PX)
    row, column = np.minimum(y // cell, 3), x // cell
    along = np.where(column % 2 == 0, x, y)
    is_bar = along % np.array(_PERIODS_PX)[row] < np.array(_PERIODS_PX)[row] / 2
    margin = cell // 8
    is_field = (np.minimum(y % cell, x % cell) >= margin) & (np.maximum(y % cell, x % cell) < cell - margin)
    return np.where(is_bar & is_field, 1.0, 0.05)


def cells(side: int, generator: np.random.Generator) -> Floats:
    """Ellipses with a bright membrane and nucleus."""
    y, x = np.indices((side, side))
    image = np.full((side, side), 0.1)
    for _ in range(_CELLS):
        center_x, center_y = generator.uniform(0, side, 2)
        length = generator.uniform(0.025, 0.07) * side
        width, turn = length * generator.uniform(0.5, 1), generator.uniform(0, np.pi)
        along = ((x - center_x) * np.cos(turn) + (y - center_y) * np.sin(turn)) / length
        across = ((y - center_y) * np.cos(turn) - (x - center_x) * np.sin(turn)) / width
        radius = np.hypot(along, across)
        image += 0.3 * (radius < 1) + 0.7 * np.exp(-(((radius - 1) / 0.12) ** 2)) + 0.6 * (radius < 0.35)
    smooth = ndimage.gaussian_filter(image, 0.7)
    return np.asarray(smooth / smooth.max())


def stars(side: int, generator: np.random.Generator) -> Floats:
    """Points of light, a pixel wide, on a faint background."""
    image = np.full((side, side), 2e-3)
    row, column = generator.integers(4, side - 4, (2, _STARS))
    np.add.at(image, (row, column), generator.uniform(2, 20, _STARS))
    smooth = ndimage.gaussian_filter(image, 1.0)
    return np.asarray(smooth / smooth.max())
