"""The lattice that the light of the cells lies on: pitch, rotation and centre, to a small part of a pixel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import Floats, Image
from reconstruction.frame.spline import spline_coefficients
from reconstruction.geometry import Lattice
from reconstruction.lattice.background import rough_background, without_background
from reconstruction.lattice.cells import CellMatch, Cells, cut, match_cells
from reconstruction.lattice.spectrum import REACH

LIT_FRACTION = 0.1  # of the light of a bright cell
_TO_PITCHES = 1 / (2 * np.pi)
_ROUGH_ROUNDS, _FINE_ROUNDS = 3, 2
_REWEIGHTINGS = 5
_OUTLYING = 4.685  # standard deviations at which a cell no longer counts (Tukey's biweight, 95 % efficient)
_FINEST = 1e-6  # pitches; a smaller scatter is rounding
_TYPICAL = 1.4826  # standard deviation of normal noise over its median magnitude
_FEWEST = 2  # lit cells
_NOTHING = 1e-30
SMALLEST_PITCH_PX = 8.0  # that `Lattice` allows
_STRIP = 1 / 32  # of a pitch: strips so wide tell a cell's edge from its middle


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A lattice whose centre is a lenslet's, and its cells."""

    lattice: Lattice
    cells: Cells
    match: CellMatch
    agreement: Floats  # of the harmonics of all cells, 1 where they have one phase; along x and y
    off_lattice: Floats  # where each cell's light lies beside the lattice, in pitches, (N, xy)


def fit_lattice(light: Image, start: Lattice, brightest: int) -> Fit | None:
    """Fit the lattice to the light of a frame (row, column), from a pitch and a rotation that are roughly right.

    A lenslet's centre is where the first harmonic of the light of all cells, along x and along y, has phase 0: the
    middle of a symmetric image. The phase is 180 degrees instead where that puts less light on the edges of the cells,
    as with a ring. At least `brightest` lenslets should be lit. None where the frame holds no 2 x 2 cells or no two of
    them are lit, or where the fit leaves the pitch it started from.
    """
    coefficients = spline_coefficients(light - rough_background(light, round(start.pitch_px)))
    lattice, sign = start, np.ones(2)
    for rough_round in range(_ROUGH_ROUNDS):
        cells = cut(coefficients, lattice)
        if not _fills_both_axes(cells):
            return None
        harmonics = sign * _evened(cells.harmonics(), brightest)
        growth = _growth(cells.index, harmonics) if rough_round else (0.0, 0.0)  # the cells must hold whole images
        lattice = _moved(lattice, np.angle(harmonics.sum(axis=0)) * _TO_PITCHES, *growth)
        if not rough_round:
            sign = _sign(cut(coefficients, lattice))
            lattice = _moved(lattice, np.where(sign < 0, 0.5, 0.0))
        if not 1 - 2 * REACH < lattice.pitch_px / start.pitch_px < 1 + 2 * REACH:
            return None
    coefficients = spline_coefficients(light)
    for _ in range(_FINE_ROUNDS):
        cells = cut(coefficients, lattice)
        if not _fills_both_axes(cells):
            return None
        match = match_cells(cells, lit_fraction=LIT_FRACTION, brightest=brightest)
        cells = without_background(cells, match.brightness)
        match = match_cells(cells, lit_fraction=LIT_FRACTION, brightest=brightest)
        typical = Cells(cells.index[:1], match.typical[None].astype(np.float32))
        offset = np.angle(typical.harmonics()[0] * sign) * _TO_PITCHES
        weight = match.is_lit * np.clip(match.brightness, 0, 1) ** 2
        if np.count_nonzero(weight) < _FEWEST:
            return None
        move, stretch, turn, off_lattice = _similarity(cells.index, match.displacement, weight)
        lattice = _moved(lattice, move + offset, stretch, turn)
    harmonics = _evened(cells.harmonics(), brightest)
    agreement = np.abs(harmonics.sum(axis=0)) / np.maximum(np.abs(harmonics).sum(axis=0), _NOTHING)
    return Fit(lattice, cells, match, agreement, off_lattice)


def _fills_both_axes(cells: Cells) -> bool:
    return len(cells.index) > 0 and bool(np.all(np.ptp(cells.index, axis=0) >= 1))


def _evened(harmonics: NDArray[np.complex128], brightest: int) -> NDArray[np.complex128]:
    """Let no cell's harmonics (N, xy) count more than those of the `brightest`-th do: one may be a reflection."""
    size = np.abs(harmonics)
    most = np.sort(size, axis=0)[-min(brightest, len(size))]
    return np.asarray(harmonics * np.minimum(1, most / np.maximum(size, _NOTHING)))


def _growth(index: NDArray[np.intp], harmonics: NDArray[np.complex128]) -> tuple[float, float]:
    """How the phase of the harmonics (N, xy) grows from cell to cell: the lattice's relative stretch, and its turn.

    Neighbours are compared, so that the lattice may be wrong by almost half a pitch from each cell to the next.
    """
    first = index.min(axis=0)
    columns, rows = index.max(axis=0) - first + 1
    grid = np.zeros((rows, columns, 2), np.complex128)
    x, y = (index - first).T
    grid[y, x] = harmonics
    along_columns = np.angle((grid[:, 1:] * grid[:, :-1].conj()).sum(axis=(0, 1))) * _TO_PITCHES
    along_rows = np.angle((grid[1:] * grid[:-1].conj()).sum(axis=(0, 1))) * _TO_PITCHES
    return float(along_columns[0] + along_rows[1]) / 2, float(along_columns[1] - along_rows[0]) / 2


def _sign(cells: Cells) -> Floats:
    """Return -1 along x or y where the light of all cells is less in the middle of a cell than on its edges, else 1."""
    light = cells.light.mean(axis=0, dtype=np.float64)
    distance = np.abs(cells.steps)
    edge, middle = distance > distance.max() - _STRIP, distance < distance.min() + _STRIP
    along = [light.mean(axis=axis) for axis in (0, 1)]
    return np.array([-1.0 if line[edge].mean() > line[middle].mean() else 1.0 for line in along])


def _similarity(index: NDArray[np.intp], displacement: Floats, weight: Floats) -> tuple[Floats, float, float, Floats]:
    """Fit a move, a stretch and a turn to displacements (N, xy), in pitches; those far from the others do not count.

    Returns them and what is left, (N, xy).
    """
    counts = weight
    for _ in range(_REWEIGHTINGS):
        counts = counts / counts.sum()
        middle, mean = counts @ index, counts @ displacement
        (x, y), (dx, dy) = (index - middle).T, (displacement - mean).T
        spread = max(float(counts @ (x**2 + y**2)), _NOTHING)
        stretch, turn = float(counts @ (x * dx + y * dy)) / spread, float(counts @ (x * dy - y * dx)) / spread
        rest = displacement - mean - np.stack([stretch * x - turn * y, stretch * y + turn * x], axis=-1)
        scatter = max(_TYPICAL * float(np.median(np.abs(rest[weight > 0]))), _FINEST)
        outlying = np.minimum(np.hypot(*rest.T) / (_OUTLYING * scatter), 1)
        counts = weight * (1 - outlying**2) ** 2
        if not counts.any():
            counts = weight
    move = mean - [stretch * middle[0] - turn * middle[1], stretch * middle[1] + turn * middle[0]]
    return move, stretch, turn, rest


def _moved(lattice: Lattice, move: Floats, stretch: float = 0.0, turn: float = 0.0) -> Lattice:
    """Move the lattice by `move` (xy), in pitches along its own axes, stretch it and turn it."""
    x_px, y_px = lattice.to_camera_px(move * lattice.pitch_px)
    return Lattice(
        center_x_px=float(x_px),
        center_y_px=float(y_px),
        pitch_px=max(lattice.pitch_px * (1 + stretch), SMALLEST_PITCH_PX),
        rotation_rad=float(np.remainder(lattice.rotation_rad + turn + np.pi / 4, np.pi / 2) - np.pi / 4),
    )
