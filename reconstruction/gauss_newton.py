"""Registration by flux-conserving Gauss-Newton: the method of this instrument.

Light imaged at x in the reference arrives at x + d(x). Light is neither made nor lost on the way, so that

    I0(x) = gain I1(x + d(x)) det(1 + dd/dx) + offset,    d(x) = sum_q c_q T_q(x / h)

with T_q the field modes and h the half width of the field on the subimage. One mode is a translation, three Legendre
modes are the paper's affine map, six and ten bend. The c_q follow from Gauss-Newton steps that need of the reference
only what `template` prepares once; a translation found on every other pixel is their start.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import NamedTuple

import numpy as np

from reconstruction.displacement import Displacement, Mask, Outcome
from reconstruction.field_modes import LegendreModes, PolynomialModes
from reconstruction.geometry import Floats
from reconstruction.kernel import align
from reconstruction.spline import Image, noise_power, spline_coefficients
from reconstruction.subimages import ReferenceSubimages
from reconstruction.template import Propagated, Template, prepare_template

_CONVERGED_PX = 0.05  # a last step above it is no convergence
_MISFIT = 0.5  # residual over contrast above which the frame shows something else than the reference
_TRANSLATION_ITERATIONS = 8
_TRANSLATION_TOLERANCE_PX = 0.2  # only a start for the warp
_ITERATIONS = 12
_TOLERANCE_PX = 1e-3
_NOISE_STEP_PX = 4  # between the places of a window where the noise of interpolation is looked at
_THREADS = min(2, os.cpu_count() or 1)
_PART = 16  # lenslets handed to a thread at a time


class _Match(NamedTuple):
    """How well L lenslets match the reference."""

    contrast: Floats  # standard deviation of the frame's subimage where the fit began, counts, (L,)
    gain: Floats  # by which the frame is as bright as the reference, (L,)
    square: Floats  # sum of the squares of the residual, counts^2, (L,)
    weighted_square: Floats  # the same with the pixels' weights, (L,)
    last_step_px: Floats  # the largest change of a coefficient in the last step, (L,)


class GaussNewton:
    """Registers frames against one reference; everything that depends on the reference alone is prepared here."""

    def __init__(self, reference: ReferenceSubimages, modes: PolynomialModes, *, conserve_flux: bool) -> None:
        """Prepare for warps of the given field modes."""
        self._reference, self._modes = reference, modes
        self._turn = reference.turn[0].astype(np.float32)
        coarse = np.all(np.mod(reference.offset_px - reference.offset_px[0], 2) == 0, axis=1)
        self._start = prepare_template(reference, LegendreModes(1), coarse, conserve_flux=conserve_flux)
        every = np.ones_like(coarse)
        self._warp = prepare_template(reference, modes, every, conserve_flux=conserve_flux, noise=reference.noise)
        some = np.all(np.mod(reference.offset_px - reference.offset_px[0], _NOISE_STEP_PX) == 0, axis=1)
        self._some_px = reference.offset_px[some]  # where the noise of interpolation is looked at, (S, xy)
        self._some_modes = modes.values(*(self._some_px.T / reference.half_width_px))  # T_q there, (Q, S)
        self._still = np.zeros((len(reference.light), 2, modes.count), np.float32)
        self._reference_power = self._noise_power(self._still)
        # Numba compiles, or loads what it has compiled, at the first call: let that not be a camera's first frame.
        blank = np.zeros((8, 8), np.float32)
        for template in (self._start, self._warp):
            self._align(
                template, blank, np.zeros((len(template.light), 2, template.basis.shape[1]), np.float32), 1, 1.0
            )

    def __call__(self, light: Image, *, saturated: Mask) -> Displacement:
        """Compare a frame with the reference; see `displacement.Estimator`."""
        reference, coefficients = self._reference, spline_coefficients(light)
        start = np.zeros((len(reference.light), 2, 1), np.float32)
        found = self._align(self._start, coefficients, start, _TRANSLATION_ITERATIONS, _TRANSLATION_TOLERANCE_PX)
        start[~(np.abs(start).max(axis=(1, 2)) <= reference.reach_px)] = 0
        fit = self._still.copy()
        fit[:, :, 0] = start[:, :, 0]
        match = self._align(self._warp, coefficients, fit, _ITERATIONS, _TOLERANCE_PX)

        residual_rms = np.sqrt(match.square / self._warp.light.shape[1])
        diverged = ~((match.last_step_px < _CONVERGED_PX) & (residual_rms < _MISFIT * reference.contrast))
        outcome = reference.judge(fit, self._modes, contrast=found.contrast, diverged=diverged, saturated=saturated)
        lost = outcome != Outcome.CONVERGED
        fit[lost] = 0  # a fit that ran away may hold anything
        covariance, chi_square = self._errors(fit, match)
        displacement = np.swapaxes(fit, 1, 2).astype(np.float64)
        for values in (displacement, covariance, chi_square, residual_rms):
            values[lost] = np.nan
        return Displacement(
            modes=self._modes,
            coefficients=displacement.reshape(*reference.lenslets, *displacement.shape[1:]),
            covariance=covariance.reshape(*reference.lenslets, *covariance.shape[1:]),
            outcome=outcome.reshape(reference.lenslets),
            residual_rms=(residual_rms / reference.contrast.max()).reshape(reference.lenslets),
            chi_square=chi_square.reshape(reference.lenslets),
        )

    def _errors(self, fit: Image, match: _Match) -> tuple[Floats, Floats]:
        """Covariance (L, Q, xy, Q, xy) of the fit (L, xy, Q), px^2, and its reduced chi-square (L,).

        The broad steepest-descent images see the slow part of the noise, which interpolation leaves as it is; the
        residual holds all of it, and so less than the pixels' own.
        """
        noise, frames = self._reference.noise, self._reference.reference_frames
        power, per_pixel, per_light = self._noise_power(fit), self._warp.per_pixel, self._warp.per_light
        if noise is None:  # what the warp does not explain is taken for noise
            variance = match.square / _residual_square(per_pixel, power)
            return per_pixel.covariance * variance[:, None, None, None, None], np.full(len(fit), np.nan)
        # Of the frame, raised by the gain to the brightness of the reference, and of the reference itself.
        shot = noise.counts_per_light * np.stack([match.gain, np.full(len(fit), 1 / frames)])
        read = noise.read_noise_counts**2 * np.stack([match.gain**2, np.full(len(fit), 1 / frames)])
        covariance = (
            shot.sum(axis=0)[:, None, None, None, None] * per_light.covariance
            + read.sum(axis=0)[:, None, None, None, None] * per_pixel.covariance
        )
        powers = np.stack([power, self._reference_power])
        expected = shot * _residual_square(per_light, powers) + read * _residual_square(per_pixel, powers)
        return covariance, match.weighted_square / expected.sum(axis=0)

    def _noise_power(self, fit: Image) -> Floats:
        """Mean variance of the interpolated values over that of a pixel, where the windows land, (L,)."""
        reference = self._reference
        position_px = np.swapaxes(fit @ self._some_modes, 1, 2) + self._some_px
        return np.asarray(noise_power(reference.center_px[:, None] + position_px @ reference.turn).mean(axis=1))

    def _align(
        self, template: Template, coefficients: Image, displacement: Image, iterations: int, tolerance_px: float
    ) -> _Match:
        """Improve `displacement` in place, lenslets shared among threads."""
        lenslets = len(displacement)
        contrast, gain, square, weighted_square, last_step_px = np.zeros((5, lenslets), np.float32)

        def part(first: int) -> None:
            align(
                coefficients,
                first,
                min(first + _PART, lenslets),
                self._reference.center_px,
                template.offset_px,
                self._turn,
                template.basis,
                template.light,
                template.inverse,
                template.weight,
                iterations,
                tolerance_px,
                displacement,
                contrast,
                gain,
                square,
                weighted_square,
                last_step_px,
            )

        list(_threads().map(part, range(0, lenslets, _PART)))
        return _Match(
            *(values.astype(np.float64) for values in (contrast, gain, square, weighted_square, last_step_px))
        )


def _residual_square(noise: Propagated, power: Floats) -> Floats:
    """Weighted sum of squares that noise leaves in the residual, interpolation weakening it by `power` (..., L)."""
    return np.asarray(power * noise.square - noise.fitted)


@cache
def _threads() -> ThreadPoolExecutor:
    """The threads that share the lenslets, for the whole program."""
    return ThreadPoolExecutor(_THREADS, thread_name_prefix="registration")
