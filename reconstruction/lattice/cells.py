"""The cells of a lattice cut out of a frame, and how the light of each compares with that of all."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from reconstruction.arrays import Floats, Image, Mask
from reconstruction.geometry import Lattice, centered_steps

_FEWEST_SAMPLES = 16  # across a cell
_BEYOND_PX = 1.0  # how far a cell that counts as whole may reach beyond the frame, or one beside it onto the frame
_SIGNIFICANT = 4.0  # standard deviations of its brightness by which a lit cell stands out of the noise


@dataclass(frozen=True, slots=True, eq=False)
class Cells:
    """The N cells of a lattice that lie whole on a frame, each at a whole number of pitches from the centre."""

    index: NDArray[np.intp]  # so many, (N, xy)
    light: Image  # S x S samples over each cell, (N, S, S)

    @property
    def steps(self) -> Floats:
        """Where a cell's samples lie, in pitches from its middle, (S,)."""
        samples = self.light.shape[-1]
        return np.asarray(centered_steps(samples) / samples)

    def harmonics(self) -> NDArray[np.complex128]:
        """First Fourier harmonic of the light of each cell along x and y, (N, xy).

        Its phase over 2 pi is how far, in pitches, the light lies from the cell's middle.
        """
        wave = np.exp(2j * np.pi * self.steps)
        return np.stack([self.light.sum(axis=1) @ wave, self.light.sum(axis=2) @ wave], axis=-1)


def cell_index(lattice: Lattice, shape: tuple[int, int], *, partial: bool = False) -> NDArray[np.intp]:
    """Which cells, in whole pitches from the centre, lie whole on a frame of that shape (row, column): (N, xy).

    Or, with `partial`, those that lie on it only in part.
    """
    last = np.array(shape[::-1]) - 1
    outline_px = np.array([[0, 0], [last[0], 0], [0, last[1]], last], np.float64)
    reach = np.abs(lattice.from_camera_px(outline_px)).max(axis=0) / lattice.pitch_px
    x, y = (np.arange(-math.ceil(most), math.ceil(most) + 1) for most in reach)
    index = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    corner = np.array([[-0.5, -0.5], [-0.5, 0.5], [0.5, -0.5], [0.5, 0.5]])
    corner_px = lattice.to_camera_px((index[:, None] + corner) * lattice.pitch_px)
    inside = np.all((corner_px > -0.5 - _BEYOND_PX) & (corner_px < last + 0.5 + _BEYOND_PX), axis=2)
    begin, end = -0.5 + _BEYOND_PX, last + 0.5 - _BEYOND_PX
    touching = np.all((corner_px.max(axis=1) > begin) & (corner_px.min(axis=1) < end), axis=1)
    return np.asarray(index[touching & ~inside.all(axis=1) if partial else inside.all(axis=1)])


def cut(coefficients: Image, lattice: Lattice) -> Cells:
    """Cut all whole cells out of a frame given by its spline coefficients (row, column)."""
    index = cell_index(lattice, coefficients.shape)
    samples = max(_FEWEST_SAMPLES, 2 * math.ceil(lattice.pitch_px / 2))
    if not len(index):
        return Cells(index, np.zeros((0, samples, samples), np.float32))
    first, last = index.min(axis=0), index.max(axis=0)
    columns, rows = last - first + 1
    cosine, sine = math.cos(lattice.rotation_rad), math.sin(lattice.rotation_rad)
    turn = np.array([[cosine, sine], [-sine, cosine]]) * lattice.pitch_px  # pitches to px, (row, column)
    start = first[::-1] - 0.5 + 0.5 / samples
    sampled = ndimage.affine_transform(
        coefficients,
        turn / samples,
        turn @ start + [lattice.center_y_px, lattice.center_x_px],
        (rows * samples, columns * samples),
        mode="mirror",
        prefilter=False,
    )
    x, y = (index - first).T
    return Cells(index, sampled.reshape(rows, samples, columns, samples)[y, :, x])


@dataclass(frozen=True, slots=True, eq=False)
class CellMatch:
    """How each of N cells compares with the typical one."""

    typical: Floats  # light of a lit cell, its mean 0, (S, S)
    brightness: Floats  # of each cell over the typical one's, (N,)
    is_lit: Mask  # (N,)
    likeness: Floats  # correlation with the typical cell, (N,)
    displacement: Floats  # of a cell's light from where the typical cell has its own, in pitches, (N, xy)


def match_cells(cells: Cells, *, lit_fraction: float, brightest: int) -> CellMatch:
    """Compare every cell with the typical one: the median of the lit ones, all made equally bright.

    A cell is lit when it has `lit_fraction` of the light of the `brightest`-th cell, and more than noise may show.
    """
    light = cells.light - cells.light.mean(axis=(1, 2), keepdims=True, dtype=np.float32)
    flat = light.reshape(len(light), -1)
    typical = flat.mean(axis=0)
    for combine in (np.mean, np.median):  # the mean is enough to tell which cells are lit
        brightness, is_lit, _ = _matched(flat, typical, lit_fraction, brightest)
        if not is_lit.any():
            break
        typical = np.asarray(combine(flat[is_lit] / brightness[is_lit, None], axis=0))
        typical = typical - typical.mean()
    brightness, is_lit, likeness = _matched(flat, typical, lit_fraction, brightest)
    shape = light.shape[1:]
    slopes = np.gradient(typical.reshape(shape), 1 / shape[0])
    model = np.stack([typical, *(slope.ravel() for slope in slopes), np.ones_like(typical)], axis=-1)
    scale, along_y, along_x, _ = np.linalg.pinv(model) @ flat.T
    scale = np.where(np.abs(scale) > np.finfo(np.float32).tiny, scale, np.inf)
    displacement = -np.stack([along_x, along_y], axis=-1) / scale[:, None]
    return CellMatch(np.asarray(typical.reshape(shape), np.float64), brightness, is_lit, likeness, displacement)


def _matched(flat: Image, typical: Image, lit_fraction: float, brightest: int) -> tuple[Floats, Mask, Floats]:
    """Brightness of cells (N, S S) over the typical one's, which are lit, and their correlation with it."""
    power = max(float(typical @ typical), float(np.finfo(np.float32).tiny))
    brightness = np.asarray(flat @ typical / power, np.float64)
    whole = np.einsum("ns,ns->n", flat, flat, dtype=np.float64)
    unlike = np.sqrt(np.maximum(whole / power - brightness**2, 0) / len(typical))
    enough = lit_fraction * np.sort(brightness)[-min(brightest, len(brightness))]
    is_lit = (brightness > enough) & (brightness > _SIGNIFICANT * unlike)
    likeness = brightness * np.sqrt(power / np.where(whole > 0, whole, np.inf), dtype=np.float64)
    return brightness, np.asarray(is_lit), np.asarray(likeness)
