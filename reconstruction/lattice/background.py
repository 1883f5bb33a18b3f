"""Smooth light between the images of the lenslets, which would pull the first harmonic of the cells to one side."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from reconstruction.arrays import Floats, Image
from reconstruction.lattice.cells import Cells

_DARKEST_PERCENT = 10.0  # of the pixels of a cell lie between the images
_PASSES = 3
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
    """Take a smooth background from cells whose images have about that `brightness`, (N,).

    Where the images almost touch, the darkest light of a cell is partly their own; that grows with their brightness,
    and stays.
    """
    size = max(float(np.abs(cells.index).max()), 1.0)
    x, y = cells.index.T / size
    brightness = _of_the_image_alone(cells, brightness)
    terms = np.concatenate([brightness[:, None], _quadratic(x, y)], axis=1)
    reluctance = np.diag(np.sqrt(_RELUCTANCE * len(terms)) * np.array([0, 0, 1, 1, 1, 1, 1]))
    solution = np.linalg.pinv(np.concatenate([terms, reluctance]))[:, : len(terms)]
    steps = cells.steps / size
    x, y = x[:, None] + steps, y[:, None] + steps  # (N, S)
    for _ in range(_PASSES):  # in a cell that lies aslant, the darkest are not those between the images
        darkest = np.percentile(cells.light, _DARKEST_PERCENT, axis=(1, 2))
        constant, along_x, along_y, xx, xy, yy = (solution @ darkest)[1:]
        by_row, by_column = constant + along_y * y + yy * y**2, along_x * x + xx * x**2
        background = by_row[:, :, None] + by_column[:, None] + xy * y[:, :, None] * x[:, None]
        cells = replace(cells, light=np.asarray(cells.light - background, np.float32))
    return cells


def _of_the_image_alone(cells: Cells, brightness: Floats) -> Floats:
    """Brightness of the cells over the typical one's, (N,), as no light that is flat or aslant in a cell changes it."""
    steps = cells.steps
    aslant = np.stack([np.ones((len(steps),) * 2), *np.meshgrid(steps, steps)]).reshape(3, -1).astype(np.float32)
    light = cells.light.reshape(len(cells.light), -1)
    light = np.asarray(light - (light @ np.linalg.pinv(aslant)) @ aslant)
    typical = brightness @ light
    power = max(float(typical @ typical), float(np.finfo(np.float32).tiny))
    return np.asarray(light @ typical * (brightness @ brightness) / power)


def _quadratic(x: Floats, y: Floats) -> Floats:
    """Powers of x and y (...) up to the second, (..., 6)."""
    return np.stack([np.ones_like(x), x, y, x**2, x * y, y**2], axis=-1)
