"""Registration: how the light of each subimage has moved between the reference and a frame.

Light imaged at x in the reference arrives at x + d(x). Light is neither made nor lost on the way, so that

    I0(x) = gain I1(x + d(x)) det(1 + dd/dx) + offset,    d(x) = sum_q c_q T_q(x / h)

with T_q the field's Legendre polynomials and h the half width of the field on the subimage. Q = 1 is a translation,
Q = 3 the paper's affine map, Q = 6 and 10 bend. The c_q follow from Gauss-Newton steps that need of the reference only
what `template` prepares once; a translation found on every other pixel is their start.
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
from reconstruction.polynomials import legendre
from reconstruction.spline import Image, sample, spline_coefficients
from reconstruction.template import Template, prepare_template

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
        light, gradient = sample(spline_coefficients(reference), np.clip(position_px, 0, edge))
        self._contrast = light.std(axis=1)
        self._dark = ~(self._contrast > _DARK_CONTRAST * np.median(self._contrast[~self._off_camera]))
        if self._dark.all() or _smoothness(light[~self._dark], steps.size) < _SMOOTH:
            raise ReconstructionError("the reference shows no light on its lenslets: was the light on?")
        self._lit = ~self._dark & ~self._off_camera
        coarse = np.all(np.mod(self._offset_px - self._offset_px[0], 2) == 0, axis=1)  # every other pixel will do
        self._start, self._warp = (
            prepare_template(
                light[:, pixels],
                (gradient @ turn.T)[:, pixels],
                lit=self._lit,
                offset_px=self._offset_px[pixels],
                half_width_px=self._half_width_px,
                modes=modes,
                conserve_flux=settings.conserve_flux,
            )
            for modes, pixels in ((1, coarse), (FIELD_MODES[settings.warp], slice(None)))
        )

    def __call__(self, coefficients: Image, *, saturated: NDArray[np.bool_] | None = None) -> Displacement:
        """Register a frame given by its spline coefficients (row, column).

        `saturated` (row, column) marks pixels at full scale; a lenslet that sees one yields no displacement.
        """
        displacement = np.zeros(self._start.variance.shape, np.float32)
        contrast, _, _ = self._align(
            self._start, coefficients, displacement, _TRANSLATION_ITERATIONS, _TRANSLATION_TOLERANCE_PX
        )
        lost = ~(np.abs(displacement).max(axis=(1, 2)) <= self._reach_px)
        start = np.where(lost[:, None], 0, displacement[:, :, 0])
        displacement = np.zeros(self._warp.variance.shape, np.float32)
        displacement[:, :, 0] = start
        _, residual_rms, last_step_px = self._align(self._warp, coefficients, displacement, _ITERATIONS, _TOLERANCE_PX)

        outcome = np.full(len(self._center_px), Outcome.CONVERGED, np.int8)
        diverged = ~((last_step_px < _CONVERGED_PX) & (residual_rms < _MISFIT * self._contrast))
        displacement[diverged] = 0  # a fit that ran away may hold anything
        outcome[self._leaves_cell(displacement)] = Outcome.LEFT_CELL
        outcome[diverged] = Outcome.DIVERGED
        if saturated is not None:
            outcome[self._sees(saturated)] = Outcome.SATURATED
        outcome[self._dark | ~(contrast > _DARK_CONTRAST * np.median(contrast[self._lit]))] = Outcome.DARK
        outcome[self._off_camera] = Outcome.OFF_CAMERA

        lost = outcome != Outcome.CONVERGED
        parameters, pixels = self._warp.inverse.shape[1:]
        noise = residual_rms.astype(np.float64) ** 2 * pixels / (pixels - parameters)
        variance = self._warp.variance * noise[:, None, None]
        variance[lost], displacement[lost], residual_rms[lost] = np.nan, np.nan, np.nan
        return Displacement(
            coefficients=np.swapaxes(displacement, 1, 2).reshape(*self._shape, -1, 2).astype(np.float64),
            variance=np.swapaxes(variance, 1, 2).reshape(*self._shape, -1, 2),
            outcome=outcome.reshape(self._shape),
            residual_rms=(residual_rms / self._contrast.max()).reshape(self._shape).astype(np.float64),
        )

    def _align(
        self, template: Template, coefficients: Image, displacement: Image, iterations: int, tolerance_px: float
    ) -> tuple[Image, Image, Image]:
        """Improve `displacement` in place, lenslets shared among threads; return contrast, residual, last step."""
        lenslets = len(self._center_px)
        contrast, residual_rms, last_step_px = np.zeros((3, lenslets), np.float32)

        def part(first: int) -> None:
            align(
                coefficients,
                first,
                min(first + _PART, lenslets),
                self._center_px,
                template.offset_px,
                self._turn,
                template.basis,
                template.light,
                template.inverse,
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
            return np.zeros(len(self._center_px), np.bool_)
        edge = np.array(marked.shape[::-1]) - 1
        turn = np.array([[self._turn[0], self._turn[1]], [-self._turn[1], self._turn[0]]])
        nearest = np.clip(np.rint(self._center_px[:, None] + self._offset_px @ turn), 0, edge).astype(np.intp)
        return np.asarray(marked[nearest[..., 1], nearest[..., 0]].any(axis=1))


_PART = 16  # lenslets handed to a thread at a time


@cache
def _threads() -> ThreadPoolExecutor:
    """The threads that share the lenslets, for the whole program."""
    return ThreadPoolExecutor(_THREADS, thread_name_prefix="registration")


def _smoothness(template: Floats, width: int) -> float:
    """Median correlation of horizontally neighbouring pixels in windows (L, width * width): ~0 for pure noise."""
    window = template.reshape(len(template), width, width)
    window = window - window.mean(axis=(1, 2), keepdims=True)
    neighbours = (window[:, :, 1:] * window[:, :, :-1]).mean(axis=(1, 2))
    return float(np.median(neighbours / (window**2).mean(axis=(1, 2))))
