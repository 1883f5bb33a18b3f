"""Registration: how the light of each subimage has moved between the reference and a frame.

Light imaged at x in the reference arrives at x + d(x). Light is neither made nor lost on the way, so that

    I0(x) = gain I1(x + d(x)) det(1 + dd/dx) + offset,    d(x) = sum_q c_q T_q(x / h)

with T_q the field's Legendre polynomials and h the half width of the field on the subimage. Q = 1 is a translation,
Q = 3 the paper's affine map, Q = 6 and 10 bend. The c_q follow from Gauss-Newton steps whose steepest-descent images
are taken from the reference: d(residual)/dc_q = d(I0 T_q)/dx, so that everything but the residual itself is computed
once per reference (after Baker and Matthews 2004, International Journal of Computer Vision 56, 221).
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from enum import IntEnum
from functools import cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from reconstruction.errors import ReconstructionError
from reconstruction.geometry import Field, Floats, Lattice, Sensor, centered_steps
from reconstruction.kernel import align
from reconstruction.polynomials import legendre, legendre_gradients
from reconstruction.spline import Image, sample, spline_coefficients

Warp = Literal["translation", "affine", "quadratic", "cubic"]
FIELD_MODES: dict[Warp, int] = {"translation": 1, "affine": 3, "quadratic": 6, "cubic": 10}


@dataclass(frozen=True, slots=True, kw_only=True)
class RegistrationSettings:
    """How the subimages may move."""

    warp: Warp = "quadratic"
    conserve_flux: bool = True


class Outcome(IntEnum):
    """What became of a lenslet; all but CONVERGED mean that it yields no slope."""

    CONVERGED = 0
    DARK = 1  # no light in the reference or in the frame
    SATURATED = 2
    DIVERGED = 3
    LEFT_CELL = 4  # the subimage reaches into the neighbour's cell: beyond the dynamic range
    OFF_CAMERA = 5  # the lenslet's cell is not wholly on the camera


@dataclass(frozen=True, slots=True, eq=False)
class Displacement:
    """How the subimages of a frame lie with respect to the reference."""

    coefficients: Floats  # c_q, px, (lenslet_row, lenslet_column, field_mode, xy); NaN where not converged
    variance: Floats  # of each coefficient, px^2, the same shape
    outcome: NDArray[np.int8]  # an `Outcome` for every lenslet, (lenslet_row, lenslet_column)
    residual_rms: Floats  # of each fit, relative to the brightest subimage of the reference; NaN likewise

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Which lenslets have converged, (lenslet_row, lenslet_column)."""
        return np.asarray(self.outcome == Outcome.CONVERGED)


@dataclass(frozen=True, slots=True, eq=False)
class _Steps:
    """What the Gauss-Newton steps of one warp need of the reference; shapes as in `kernel.align`."""

    basis: Image
    inverse: Image
    variance: Floats  # of each displacement coefficient per unit of pixel variance, (L, xy, Q)


_OFF_CAMERA_FRACTION = 0.5  # of the lenslets; with more, the lattice belongs to another frame
_DARK_CONTRAST = 0.1  # of the median lenslet's contrast; below it a lenslet counts as unlit
_SMOOTH = 0.2  # correlation of neighbouring pixels below which a reference is noise and no image
_CONVERGED_PX = 0.05  # a last step above it is no convergence
_MISFIT = 0.5  # residual over contrast above which the frame shows something else than the reference
_TRANSLATION_ITERATIONS = 8
_TRANSLATION_TOLERANCE_PX = 0.2  # only a start for the warp
_ITERATIONS = 12
_TOLERANCE_PX = 1e-3
_THREADS = min(2, os.cpu_count() or 1)


class Registration:
    """Registers frames against one reference; everything that depends on the reference alone is prepared here."""

    def __init__(
        self, reference: Image, *, sensor: Sensor, lattice: Lattice, field: Field, settings: RegistrationSettings
    ) -> None:
        """Prepare for `reference` (row, column), counts."""
        self._shape = (sensor.lenslet_rows, sensor.lenslet_columns)
        self._center_px = lattice.lenslet_centers_px(*self._shape).reshape(-1, 2)
        self._half_width_px = field.half_width_px(sensor)
        blur_px = sensor.wavelength_m * sensor.lenslet_focal_length_m / sensor.lenslet_pitch_m / sensor.pixel_pitch_m
        self._reach_px = (lattice.pitch_px - blur_px) / 2  # a field's edge beyond it has light in the next cell
        self._conserve_flux = settings.conserve_flux
        steps = centered_steps(int(lattice.pitch_px))
        y, x = (grid.ravel() for grid in np.meshgrid(steps, steps, indexing="ij"))
        self._offset_px = np.stack([x, y], axis=-1).astype(np.float32)
        cosine, sine = np.cos(lattice.rotation_rad), np.sin(lattice.rotation_rad)
        self._turn = np.array([cosine, sine], np.float32)
        turn = np.array([[cosine, sine], [-sine, cosine]])

        position_px = self._center_px[:, None] + self._offset_px.astype(np.float64) @ turn
        edge = np.array(reference.shape[::-1]) - 1
        self._off_camera = np.any((position_px < -0.5) | (position_px > edge + 0.5), axis=(1, 2))
        if np.mean(self._off_camera) > _OFF_CAMERA_FRACTION:
            rows, columns = reference.shape
            raise ReconstructionError(
                f"most lenslets lie beside the frame of {rows} x {columns} pixels: check [lattice] and the frame's size"
            )
        template, gradient = sample(spline_coefficients(reference), np.clip(position_px, 0, edge))
        self._template = template.astype(np.float32)
        self._contrast = template.std(axis=1)
        self._dark = ~(self._contrast > _DARK_CONTRAST * np.median(self._contrast[~self._off_camera]))
        if self._dark.all() or _smoothness(template[~self._dark], steps.size) < _SMOOTH:
            raise ReconstructionError("the reference shows no light on its lenslets: was the light on?")
        lit = ~self._dark & ~self._off_camera
        self._steps = tuple(
            _prepare_steps(
                template,
                gradient @ turn.T,
                lit=lit,
                offset_px=self._offset_px,
                half_width_px=self._half_width_px,
                modes=modes,
                conserve_flux=settings.conserve_flux,
            )
            for modes in (1, FIELD_MODES[settings.warp])
        )

    def __call__(self, coefficients: Image, *, saturated: NDArray[np.bool_] | None = None) -> Displacement:
        """Register a frame given by its spline coefficients (row, column).

        `saturated` (row, column) marks pixels at full scale; a lenslet that sees one yields no displacement.
        """
        displacement = np.zeros((len(self._template), 2, 1), np.float32)
        contrast, _, _ = self._align(
            self._steps[0], coefficients, displacement, _TRANSLATION_ITERATIONS, _TRANSLATION_TOLERANCE_PX
        )
        lost = ~(np.abs(displacement).max(axis=(1, 2)) <= self._reach_px)
        start = np.where(lost[:, None], 0, displacement[:, :, 0])
        displacement = np.zeros((len(self._template), *self._steps[1].variance.shape[1:]), np.float32)
        displacement[:, :, 0] = start
        _, residual_rms, last_step_px = self._align(
            self._steps[1], coefficients, displacement, _ITERATIONS, _TOLERANCE_PX
        )

        outcome = np.full(len(self._template), Outcome.CONVERGED, np.int8)
        outcome[self._leaves_cell(displacement)] = Outcome.LEFT_CELL
        outcome[~((last_step_px < _CONVERGED_PX) & (residual_rms < _MISFIT * self._contrast))] = Outcome.DIVERGED
        if saturated is not None:
            outcome[self._sees(saturated)] = Outcome.SATURATED
        lit = ~self._dark & ~self._off_camera
        outcome[self._dark | ~(contrast > _DARK_CONTRAST * np.median(contrast[lit]))] = Outcome.DARK
        outcome[self._off_camera] = Outcome.OFF_CAMERA

        lost = outcome != Outcome.CONVERGED
        pixels, parameters = self._template.shape[1], self._steps[1].inverse.shape[1]
        noise = residual_rms.astype(np.float64) ** 2 * pixels / (pixels - parameters)
        variance = self._steps[1].variance * noise[:, None, None]
        variance[lost], displacement[lost], residual_rms[lost] = np.nan, np.nan, np.nan
        return Displacement(
            coefficients=np.swapaxes(displacement, 1, 2).reshape(*self._shape, -1, 2).astype(np.float64),
            variance=np.swapaxes(variance, 1, 2).reshape(*self._shape, -1, 2),
            outcome=outcome.reshape(self._shape),
            residual_rms=(residual_rms / self._contrast.max()).reshape(self._shape).astype(np.float64),
        )

    def _align(
        self, steps: _Steps, coefficients: Image, displacement: Image, iterations: int, tolerance_px: float
    ) -> tuple[Image, Image, Image]:
        """Improve `displacement` in place, lenslets shared among threads; return contrast, residual, last step."""
        lenslets = len(self._template)
        contrast, residual_rms, last_step_px = np.zeros((3, lenslets), np.float32)

        def part(first: int) -> None:
            align(
                coefficients,
                first,
                min(first + _PART, lenslets),
                self._center_px,
                self._offset_px,
                self._turn,
                steps.basis,
                self._template,
                steps.inverse,
                self._conserve_flux,
                iterations,
                tolerance_px,
                displacement,
                contrast,
                residual_rms,
                last_step_px,
            )

        list(_threads().map(part, range(0, lenslets, _PART)))
        return contrast, residual_rms, last_step_px

    def _leaves_cell(self, displacement: Image) -> NDArray[np.bool_]:
        """Whether the field's edge is imaged beyond the lenslet's cell, (L,)."""
        x, y = (grid.ravel() for grid in np.meshgrid([-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0]))
        modes = legendre(displacement.shape[2], x, y)
        edge_px = displacement @ modes + self._half_width_px * np.stack([x, y])
        return np.asarray(np.abs(edge_px).max(axis=(1, 2)) > self._reach_px)

    def _sees(self, marked: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Whether any pixel in the lenslet's cell is marked, (L,)."""
        if not marked.any():
            return np.zeros(len(self._template), np.bool_)
        edge = np.array(marked.shape[::-1]) - 1
        turn = np.array([[self._turn[0], self._turn[1]], [-self._turn[1], self._turn[0]]])
        nearest = np.clip(np.rint(self._center_px[:, None] + self._offset_px @ turn), 0, edge).astype(np.intp)
        return np.asarray(marked[nearest[..., 1], nearest[..., 0]].any(axis=1))


_PART = 16  # lenslets handed to a thread at a time


@cache
def _threads() -> ThreadPoolExecutor:
    """The threads that share the lenslets, for the whole program."""
    return ThreadPoolExecutor(_THREADS, thread_name_prefix="registration")


def _prepare_steps(
    template: Floats,
    gradient: Floats,
    *,
    lit: NDArray[np.bool_],
    offset_px: Image,
    half_width_px: float,
    modes: int,
    conserve_flux: bool,
) -> _Steps:
    """Prepare the steps of the warp with `modes` field modes T_q for windows at `offset_px` (N, xy).

    The steepest-descent images of the template I0 (L, N) with gradient (L, N, xy) are, for d along x,
    d(I0 T_q)/dx = T_q dI0/dx + I0 dT_q/dx; the second term is the flux. Those of gain and offset are I0 and 1.
    """
    x, y = offset_px.T.astype(np.float64) / half_width_px
    values = legendre(modes, x, y)
    slopes = legendre_gradients(modes, x, y) / half_width_px
    flux = template[lit, None] if conserve_flux else np.zeros((1, 1, 1))
    descent = np.concatenate(
        [
            gradient[lit, None, :, 0] * values + flux * slopes[..., 0],
            gradient[lit, None, :, 1] * values + flux * slopes[..., 1],
            template[lit, None],
            np.ones((np.count_nonzero(lit), 1, template.shape[1])),
        ],
        axis=1,
    )
    norm = np.linalg.norm(descent, axis=2, keepdims=True)
    descent /= norm
    covariance = np.linalg.pinv(descent @ np.swapaxes(descent, 1, 2), rcond=1e-9, hermitian=True)
    inverse = np.zeros((len(template), *descent.shape[1:]), np.float32)
    inverse[lit] = covariance @ descent / norm
    variance = np.zeros((len(template), 2, modes))
    diagonal = np.diagonal(covariance, axis1=1, axis2=2) / norm[..., 0] ** 2
    variance[lit] = diagonal[:, : 2 * modes].reshape(-1, 2, modes)
    basis = np.stack([values, slopes[..., 0], slopes[..., 1]]).astype(np.float32)
    return _Steps(basis=basis, inverse=inverse, variance=variance)


def _smoothness(template: Floats, width: int) -> float:
    """Median correlation of horizontally neighbouring pixels in windows (L, width * width): ~0 for pure noise."""
    window = template.reshape(len(template), width, width)
    window = window - window.mean(axis=(1, 2), keepdims=True)
    neighbours = (window[:, :, 1:] * window[:, :, :-1]).mean(axis=(1, 2))
    return float(np.median(neighbours / (window**2).mean(axis=(1, 2))))
