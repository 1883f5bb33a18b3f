"""Smooth light between the images of the lenslets, which would pull the first harmonic of the cells to one side."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from reconstruction.geometry import Floats
from reconstruction.lattice_cells import Cells
from reconstruction.spline import Image

_DARKEST_PERCENT = 10.0  # of the pixels of a cell lie between the images
_RELUCTANCE = 1e-3  # of explaining by a background what the images' own light explains as well


def rough_background(light: Image, pitch_px: int) -> Image:
    """Quadratic surface through the darkest of every square of a pitch, (row, column), wherever the lattice lies."""
    rows, columns = (length // pitch_px for length in light.shape)
    squares = light[: rows * pitch_px, : columns * pitch_px].reshape(rows, pitch_px, columns, pitch_px)
    darkest = np.percentile(squares, _DARKEST_PERCENT, axis=(1, 3))
    y, x = (((np.arange(count) + 0.5) * pitch_px - 0.5) for count in (rows, columns))
    y, x = (2 * where / length - 1 for where, length in zip((y, x), light.shape, strict=True))
    terms = _quadratic(*np.meshgrid(x, y))
    surface, *_ = np.linalg.lstsq(terms.reshape(-1, 6), darkest.ravel(), rcond=None)
    constant, along_x, along_y, xx, xy, yy = surface
    y, x = (2 * np.arange(length) / length - 1 for length in light.shape)
    by_row, by_column = constant + along_y * y + yy * y**2, along_x * x + xx * x**2
    return np.asarray(by_row[:, None] + by_column + xy * np.outer(y, x), np.float32)


def without_background(cells: Cells, brightness: Floats) -> Cells:
    """Take a smooth background from cells whose images have that `brightness`, (N,).

    Where the images almost touch, the darkest light of a cell is partly their own; that grows with their brightness,
    and stays.
    """
    darkest = np.percentile(cells.light, _DARKEST_PERCENT, axis=(1, 2))
    size = max(float(np.abs(cells.index).max()), 1.0)
    x, y = cells.index.T / size
    terms = np.concatenate([brightness[:, None], _quadratic(x, y)], axis=1)
    reluctance = np.diag(np.sqrt(_RELUCTANCE * len(terms)) * np.array([0, 0, 1, 1, 1, 1, 1]))
    surface, *_ = np.linalg.lstsq(
        np.concatenate([terms, reluctance]), np.concatenate([darkest, np.zeros(7)]), rcond=None
    )
    steps = cells.steps / size
    constant, along_x, along_y, xx, xy, yy = surface[1:]
    x, y = x[:, None] + steps, y[:, None] + steps  # (N, S)
    by_row, by_column = constant + along_y * y + yy * y**2, along_x * x + xx * x**2
    background = by_row[:, :, None] + by_column[:, None] + xy * y[:, :, None] * x[:, None]
    return replace(cells, light=np.asarray(cells.light - background, np.float32))


def _quadratic(x: Floats, y: Floats) -> Floats:
    """Powers of x and y (...) up to the second, (..., 6)."""
    return np.stack([np.ones_like(x), x, y, x**2, x * y, y**2], axis=-1)
