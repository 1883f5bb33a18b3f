"""Cells of a lattice, cut out of a frame: their comparison, and the light between them."""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from reconstruction.arrays import Booleans, Floats, Image
from reconstruction.frame.pixels import ON_FRAME
from reconstruction.frame.spline import interpolate_evenly
from reconstruction.geometry import Lattice, centered_steps

_FEWEST_SAMPLES = 16  # across a cell
_BEYOND_PX = 1.0  # tolerance: a complete cell may reach so far beyond the frame
_LIT = 0.1  # of the light of a bright cell
_SIGNIFICANT = 4.0  # standard deviations of its brightness by which a lit cell exceeds the noise
_DARKEST_PERCENT = 10.0  # percentile of a cell's pixels taken as background
_PASSES = 3
_DAMPING = 1e-3  # prefers the images' own light to a background where both fit


@dataclass(frozen=True, slots=True, eq=False)
class Cells:
    """N cells of a lattice on a frame, whole columns and rows from the centre each."""

    index: NDArray[np.intp]  # column and row, (N, xy)
    light: Image  # S x S samples over each cell, (N, S, S)
    lattice: Lattice

    @property
    def position(self) -> Floats:
        """Middles of the cells in pitches, (N, xy)."""
        return self.lattice.cell_positions(self.index)

    @property
    def steps(self) -> Floats:
        """Sample positions in a cell, in its widths or heights from its middle, (S,)."""
        samples = self.light.shape[-1]
        return np.asarray(centered_steps(samples) / samples)

    def harmonics(self) -> NDArray[np.complex128]:
        """First Fourier harmonic of each cell's light along x and y, (N, xy); see `offset`."""
        wave = np.exp(2j * np.pi * self.steps)
        return np.stack([self.light.sum(axis=1) @ wave, self.light.sum(axis=2) @ wave], axis=-1)

    def offset(self, cycles: Floats) -> Floats:
        """Offset of light from its cell's middle, in pitches, from phases (..., xy) of the harmonics.

        That along x is weak where cells of a hexagonal lattice hold halves of two rows: y must be known first.
        """
        return np.asarray(cycles * [1.0, self.lattice.row_spacing])


def cell_index(lattice: Lattice, shape: tuple[int, int], *, only_partial: bool = False) -> NDArray[np.intp]:
    """Cells, (column, row) from the centre, on a frame of that shape, entirely or `only_partial`: (N, xy)."""
    last = np.array(shape[::-1]) - 1
    outline_px = np.array([[0, 0], [last[0], 0], [0, last[1]], last], np.float64)
    reach = np.abs(lattice.in_pitches(outline_px)).max(axis=0) / [1.0, lattice.row_spacing]
    x, y = (np.arange(-math.ceil(most), math.ceil(most) + 1) for most in reach)
    index = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    corner_px = lattice.camera_px(lattice.cell_positions(index)[:, None] + lattice.cell_corners)
    inside = np.all((corner_px > -0.5 - _BEYOND_PX) & (corner_px < last + 0.5 + _BEYOND_PX), axis=2)
    begin, end = -0.5 + _BEYOND_PX, last + 0.5 - _BEYOND_PX
    touching = np.all((corner_px.max(axis=1) > begin) & (corner_px.min(axis=1) < end), axis=1)
    return np.asarray(index[touching & ~inside.all(axis=1) if only_partial else inside.all(axis=1)])


def cut(coefficients: Image, lattice: Lattice, *, only_partial: bool = False) -> Cells:
    """Cut all complete cells, or the others, out of a frame given by its spline coefficients (row, column)."""
    index = cell_index(lattice, coefficients.shape, only_partial=only_partial)
    samples = max(_FEWEST_SAMPLES, 2 * math.ceil(lattice.pitch_px / 2))
    if not len(index):
        return Cells(index, np.zeros((0, samples, samples), np.float32), lattice)
    first, last = index.min(axis=0), index.max(axis=0)
    columns, rows = last - first + 1
    beside = 0 if lattice.arrangement == "square" else samples // 2  # samples by which odd rows lie to the right
    size = np.array([1.0, lattice.row_spacing])
    sampled = interpolate_evenly(
        coefficients,
        lattice.camera_px((first - 0.5 + 0.5 / samples) * size),
        np.diag(size / samples) @ lattice.pitch_matrix_px @ lattice.turn,
        (rows * samples, columns * samples + beside),
    )
    column, row = (index - first).T
    start = column * samples + index[:, 1] % 2 * beside
    windows = sliding_window_view(sampled.reshape(rows, samples, -1), samples, axis=2)
    return Cells(index, windows[row, :, start], lattice)


@dataclass(frozen=True, slots=True, eq=False)
class CellMatch:
    """Comparison of N cells with the typical cell."""

    typical: Floats  # light of a lit cell, its mean 0, (S, S)
    brightness: Floats  # of each cell over the typical one's, (N,)
    is_lit: Booleans  # (N,)
    likeness: Floats  # correlation with the typical cell, (N,)
    displacement: Floats  # from the light of the typical cell, in pitches, (N, xy)


def match_cells(cells: Cells, *, brightest: int) -> CellMatch:
    """Compare every cell with the typical one, the median of the lit cells scaled to equal brightness.

    A cell is lit if it has a tenth of the light of the `brightest`-th cell, and significantly more than noise.
    """
    light = cells.light - cells.light.mean(axis=(1, 2), keepdims=True, dtype=np.float32)
    flat = light.reshape(len(light), -1)
    typical = flat.mean(axis=0)
    for combine in (np.mean, np.median):  # the mean suffices to decide which cells are lit
        brightness, is_lit, _ = _matched(flat, typical, brightest)
        if not is_lit.any():
            break
        typical = np.asarray(combine(flat[is_lit] / brightness[is_lit, None], axis=0))
        typical = typical - typical.mean()
    brightness, is_lit, likeness = _matched(flat, typical, brightest)
    shape = light.shape[1:]
    scaled = np.linalg.pinv(_moving(typical.reshape(shape))) @ flat.T
    displacement = _displacement(scaled, cells.lattice)
    return CellMatch(np.asarray(typical.reshape(shape), np.float64), brightness, is_lit, likeness, displacement)


def match_partial_cells(
    cells: Cells, frame: tuple[int, ...], whole: CellMatch, *, brightest: int
) -> tuple[Booleans, Floats]:
    """Compare cells that a frame of that shape cuts with the typical one of the `whole` cells.

    Returns which are lit, (N,), and their displacement in pitches, (N, xy). Only samples on the frame count; a cell
    whose image may lie beyond it is not lit.
    """
    steps, lattice = np.stack(np.meshgrid(cells.steps, cells.steps * cells.lattice.row_spacing), axis=-1), cells.lattice
    at_px = lattice.camera_px(cells.position[:, None] + steps.reshape(-1, 2))
    on_frame = np.all((at_px > -0.5) & (at_px < np.array(frame[::-1]) - 0.5), axis=-1)  # (N, S S)
    model = _moving(whole.typical)
    steepness = np.sum(model[:, 1:3] ** 2, axis=1)
    flat = cells.light.reshape(len(cells.light), steps.size // 2)  # there may be none
    found = np.zeros((4, len(flat)))
    unlike = np.full(len(flat), np.inf)
    for n in np.flatnonzero(on_frame @ steepness > ON_FRAME * steepness.sum()):
        some = on_frame[n]
        found[:, n] = np.linalg.lstsq(model[some], flat[n, some], rcond=None)[0]
        unlike[n] = np.std(flat[n, some] - model[some] @ found[:, n])
    enough = _LIT * np.sort(whole.brightness)[-min(brightest, len(whole.brightness))]
    is_lit = (found[0] > enough) & (found[0] > _SIGNIFICANT * unlike / whole.typical.std() / cells.light.shape[-1])
    return is_lit, _displacement(found, lattice)


def _moving(typical: Floats) -> Floats:
    """Images (S S, 4) that make a moved cell: the typical one (S, S), its slopes along y and x, and a constant."""
    slopes = np.gradient(typical, 1 / len(typical))
    return np.stack([each.ravel() for each in (typical, *slopes, np.ones_like(typical))], axis=-1)


def _displacement(shares: Floats, lattice: Lattice) -> Floats:
    """Displacement in pitches, (N, xy), of cells with those shares (4, N) of the images of `_moving`."""
    scale, along_y, along_x, _ = shares
    scale = np.where(np.abs(scale) > np.finfo(np.float32).tiny, scale, np.inf)
    return -np.stack([along_x, along_y * lattice.row_spacing], axis=-1) / scale[:, None]


def _matched(flat: Image, typical: Image, brightest: int) -> tuple[Floats, Booleans, Floats]:
    """Brightness of cells (N, S S) over the typical one, which are lit, and their correlation with it."""
    power = max(float(typical @ typical), float(np.finfo(np.float32).tiny))
    brightness = np.asarray(flat @ typical / power, np.float64)
    whole = np.einsum("ns,ns->n", flat, flat, dtype=np.float64)
    unlike = np.sqrt(np.maximum(whole / power - brightness**2, 0) / len(typical))
    enough = _LIT * np.sort(brightness)[-min(brightest, len(brightness))]
    is_lit = (brightness > enough) & (brightness > _SIGNIFICANT * unlike)
    likeness = brightness * np.sqrt(power / np.where(whole > 0, whole, np.inf), dtype=np.float64)
    return brightness, np.asarray(is_lit), np.asarray(likeness)


def rough_background(light: Image, pitch_px: int) -> Image:
    """Quadratic surface (row, column) through the darkest pixels of every square of one pitch."""
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
    """Subtract a smooth background from cells whose images have about that relative `brightness`, (N,).

    Where images almost touch, part of the darkest light in a cell is their own; it grows with their brightness and
    stays.
    """
    size = max(float(np.abs(cells.position).max()), 1.0)
    x, y = cells.position.T / size
    brightness = _image_brightness(cells, brightness)
    terms = np.concatenate([brightness[:, None], _quadratic(x, y)], axis=1)
    damping = np.diag(np.sqrt(_DAMPING * len(terms)) * np.array([0, 0, 1, 1, 1, 1, 1]))
    solution = np.linalg.pinv(np.concatenate([terms, damping]))[:, : len(terms)]
    steps = cells.steps / size
    x, y = x[:, None] + steps, y[:, None] + steps * cells.lattice.row_spacing  # (N, S)
    for _ in range(_PASSES):  # with a sloping background, the darkest pixels are not those between the images
        darkest = np.percentile(cells.light, _DARKEST_PERCENT, axis=(1, 2))
        constant, along_x, along_y, xx, xy, yy = (solution @ darkest)[1:]
        by_row, by_column = constant + along_y * y + yy * y**2, along_x * x + xx * x**2
        background = by_row[:, :, None] + by_column[:, None] + xy * y[:, :, None] * x[:, None]
        cells = replace(cells, light=np.asarray(cells.light - background, np.float32))
    return cells


def _image_brightness(cells: Cells, brightness: Floats) -> Floats:
    """Relative brightness of the cells, (N,), unaffected by light that is constant or linear over a cell."""
    steps = cells.steps
    linear = np.stack([np.ones((len(steps),) * 2), *np.meshgrid(steps, steps)]).reshape(3, -1).astype(np.float32)
    light = cells.light.reshape(len(cells.light), -1)
    light = np.asarray(light - (light @ np.linalg.pinv(linear)) @ linear)
    typical = brightness @ light
    power = max(float(typical @ typical), float(np.finfo(np.float32).tiny))
    return np.asarray(light @ typical * (brightness @ brightness) / power)


def _quadratic(x: Floats, y: Floats) -> Floats:
    """Powers of x and y (...) up to the second, (..., 6)."""
    return np.stack([np.ones_like(x), x, y, x**2, x * y, y**2], axis=-1)
