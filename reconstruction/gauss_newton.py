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

import numpy as np

from reconstruction.displacement import Displacement, Mask, Outcome
from reconstruction.field_modes import LegendreModes, PolynomialModes
from reconstruction.kernel import align
from reconstruction.spline import Image, noise_power, spline_coefficients
from reconstruction.subimages import ReferenceSubimages
from reconstruction.template import Template, prepare_template

_CONVERGED_PX = 0.05  # a last step above it is no convergence
_MISFIT = 0.5  # residual over contrast above which the frame shows something else than the reference
_TRANSLATION_ITERATIONS = 8
_TRANSLATION_TOLERANCE_PX = 0.2  # only a start for the warp
_ITERATIONS = 12
_TOLERANCE_PX = 1e-3
_THREADS = min(2, os.cpu_count() or 1)
_PART = 16  # lenslets handed to a thread at a time


class GaussNewton:
    """Registers frames against one reference; everything that depends on the reference alone is prepared here."""

    def __init__(self, reference: ReferenceSubimages, modes: PolynomialModes, *, conserve_flux: bool) -> None:
        """Prepare for warps of the given field modes."""
        self._reference, self._modes = reference, modes
        self._turn = reference.turn[0].astype(np.float32)
        coarse = np.all(np.mod(reference.offset_px - reference.offset_px[0], 2) == 0, axis=1)
        self._start = prepare_template(reference, LegendreModes(1), coarse, conserve_flux=conserve_flux)
        every = np.ones_like(coarse)
        self._warp = prepare_template(reference, modes, every, conserve_flux=conserve_flux)
        # Numba compiles, or loads what it has compiled, at the first call: let that not be a camera's first frame.
        blank = np.zeros((8, 8), np.float32)
        for template in (self._start, self._warp):
            self._align(template, blank, np.zeros(template.variance.shape, np.float32), 1, 1.0)

    def __call__(self, light: Image, *, saturated: Mask) -> Displacement:
        """Compare a frame with the reference; see `displacement.Estimator`."""
        reference, coefficients = self._reference, spline_coefficients(light)
        start = np.zeros(self._start.variance.shape, np.float32)
        contrast, _, _ = self._align(
            self._start, coefficients, start, _TRANSLATION_ITERATIONS, _TRANSLATION_TOLERANCE_PX
        )
        start[~(np.abs(start).max(axis=(1, 2)) <= reference.reach_px)] = 0
        fit = np.zeros(self._warp.variance.shape, np.float32)
        fit[:, :, 0] = start[:, :, 0]
        _, residual_rms, last_step_px = self._align(self._warp, coefficients, fit, _ITERATIONS, _TOLERANCE_PX)

        diverged = ~((last_step_px < _CONVERGED_PX) & (residual_rms < _MISFIT * reference.contrast))
        outcome = reference.judge(fit, self._modes, contrast=contrast, diverged=diverged, saturated=saturated)
        parameters, pixels = self._warp.inverse.shape[1:]
        lost = outcome != Outcome.CONVERGED
        fit[lost] = 0  # a fit that ran away may hold anything
        # The residual holds interpolated noise, weaker than the pixels' own. The broad steepest-descent images see the
        # slow part of the noise, which interpolation leaves as it is.
        landing_px = reference.center_px + reference.offset_px[0] @ reference.turn + fit[:, :, 0] @ reference.turn
        noise = residual_rms.astype(np.float64) ** 2 * pixels / (pixels - parameters) / noise_power(landing_px)
        variance = self._warp.variance * noise[:, None, None]
        variance[lost], fit[lost], residual_rms[lost] = np.nan, np.nan, np.nan
        return Displacement(
            modes=self._modes,
            coefficients=np.swapaxes(fit, 1, 2).reshape(*reference.lenslets, -1, 2).astype(np.float64),
            variance=np.swapaxes(variance, 1, 2).reshape(*reference.lenslets, -1, 2),
            outcome=outcome.reshape(reference.lenslets),
            residual_rms=(residual_rms / reference.contrast.max()).reshape(reference.lenslets).astype(np.float64),
        )

    def _align(
        self, template: Template, coefficients: Image, displacement: Image, iterations: int, tolerance_px: float
    ) -> tuple[Image, Image, Image]:
        """Improve `displacement` in place, lenslets shared among threads; return contrast, residual, last step."""
        lenslets = len(displacement)
        contrast, residual_rms, last_step_px = np.zeros((3, lenslets), np.float32)

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
                iterations,
                tolerance_px,
                displacement,
                contrast,
                residual_rms,
                last_step_px,
            )

        list(_threads().map(part, range(0, lenslets, _PART)))
        return contrast, residual_rms, last_step_px


@cache
def _threads() -> ThreadPoolExecutor:
    """The threads that share the lenslets, for the whole program."""
    return ThreadPoolExecutor(_THREADS, thread_name_prefix="registration")
