"""The compiled loop over the lenslets: from which start each is fitted, and how much noise interpolation leaves."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import Floats, Image
from reconstruction.registration.gauss_newton.alignment import LOST_PX, FrameData, Grid, State, fit_warp
from reconstruction.registration.gauss_newton.warped_sampling import Scratch, new_scratch
from reconstruction.registration.gauss_newton.whole_pixel_search import WholePixelSearch, best_shift
from reconstruction.runtime.compilation import compiled

_NOISE_STRIDE = 7  # pixels between those where the noise of interpolation is looked at; no divisor of a window's width


class FitLimits(NamedTuple):
    """When a fit has settled and when it is no match, for translations (`start_`) and warps."""

    start_iterations: int
    start_tolerance_px: np.float32
    iterations: int
    tolerance_px: np.float32
    converged_px: np.float32  # a last step above it is no convergence
    # Square of a residual above which another start is tried, as a polynomial of the gain: (L, 3), counts^2.
    poor_square: Image


class Fits(NamedTuple):
    """What becomes of L lenslets with Q field modes; filled in."""

    displacement: Image  # in: where a fit begins, NaN for the start of its own; out: the fit, px, (L, xy, Q)
    contrast: Floats  # standard deviation of the frame's subimage where the fit began, counts, (L,)
    gain: Floats  # by which the frame's light makes the reference's, (L,)
    square: Floats  # weighted sum of the residual's squares before the last step, counts^2, (L,)
    step_px: Floats  # the largest change of a coefficient in the last step, (L,)
    noise_power: Floats  # share of the pixels' noise that interpolation leaves: of uniform, of shot noise, (L, 2)
    is_partial: NDArray[np.bool_]  # whether pixels were left out, (L,)
    excluded: NDArray[np.bool_]  # which ones, (L, N)


@compiled
def fit_lenslets(  # noqa: PLR0913, PLR0917 - compiled code takes its arguments by their place
    frame: FrameData,
    start: Grid,
    warp: Grid,
    search: WholePixelSearch,
    limits: FitLimits,
    power: Floats,
    fits: Fits,
    first: int,
    step: int,
) -> None:
    """Fit every `step`-th lenslet from `first` on.

    `start` holds the reference for translations on a coarse grid, `warp` that of the warps. Where that ends nowhere,
    the whole-pixel search gives another start. `power` (4,): see `spline.noise_power_polynomial`.
    """
    scratch = new_scratch(warp.uv.shape[1])
    coarse = new_scratch(start.uv.shape[1])
    patch = new_scratch(search.uv.shape[1])
    cell = frame.half_cell_px
    settled = (limits.iterations, limits.tolerance_px)
    for lenslet in range(first, fits.gain.size, step):
        if not np.any(warp.weight[lenslet]):
            fits.step_px[lenslet] = LOST_PX
            continue
        displacement = fits.displacement[lenslet]
        state = State(np.float32(np.inf), LOST_PX, np.float32(1.0), np.float32(0.0), False)
        poor = True
        if np.all(np.isfinite(displacement)):
            state = fit_warp(frame, warp, lenslet, displacement, settled, scratch)
            poor = _is_poor(state, limits, lenslet)
        if poor:
            translation = np.zeros((2, 1), np.float32)
            fit_warp(frame, start, lenslet, translation, (limits.start_iterations, limits.start_tolerance_px), coarse)
            displacement[:] = 0
            if max(abs(translation[0, 0]), abs(translation[1, 0])) < cell:
                displacement[0, 0], displacement[1, 0] = translation[0, 0], translation[1, 0]
            state = fit_warp(frame, warp, lenslet, displacement, settled, scratch)
            poor = _is_poor(state, limits, lenslet)
        if poor and search.reach > 0:
            again = np.zeros_like(displacement)
            best_shift(frame, search, lenslet, again, patch)
            other = fit_warp(frame, warp, lenslet, again, settled, scratch)
            better = other.square < state.square if state.step_px < limits.converged_px else True
            if other.step_px < limits.converged_px and better:
                displacement[:] = again
                state = other
            elif state.step_px < limits.converged_px:  # as before; the pixels left out are looked up again
                state = fit_warp(frame, warp, lenslet, displacement, settled, scratch)
        fits.contrast[lenslet], fits.gain[lenslet] = state.contrast, state.gain
        fits.square[lenslet], fits.step_px[lenslet] = state.square, state.step_px
        fits.is_partial[lenslet] = state.is_partial
        if state.is_partial:
            fits.excluded[lenslet] = scratch.excluded
        _interpolated_noise(warp.weight[lenslet], warp.light[lenslet], power, scratch, fits.noise_power[lenslet])


@compiled
def _is_poor(state: State, limits: FitLimits, lenslet: int) -> bool:
    """Whether another start might do better."""
    poor = limits.poor_square[lenslet]
    enough = state.square < poor[0] + state.gain * (poor[1] + state.gain * poor[2])
    return not (state.step_px < limits.converged_px and enough)


@compiled
def _interpolated_noise(weight: Image, light: Image, power: Floats, scratch: Scratch, found: Floats) -> None:
    """Mean share of the noise that interpolation leaves where a window has landed: of uniform, of shot noise, (2,)."""
    pixels, shot, left_pixels, left_shot = 0.0, 0.0, 0.0, 0.0
    for n in range(0, weight.size, _NOISE_STRIDE):
        x, y = scratch.x[n] - np.floor(scratch.x[n]), scratch.y[n] - np.floor(scratch.y[n])
        p, q = x * (1 - x), y * (1 - y)
        left = power[0] + p * (power[1] + p * (power[2] + p * power[3]))
        left *= power[0] + q * (power[1] + q * (power[2] + q * power[3]))
        one = weight[n]
        much = weight[n] * max(light[n], np.float32(0.0))
        pixels += one
        shot += much
        left_pixels += one * left
        left_shot += much * left
    found[0], found[1] = left_pixels / max(pixels, 1e-30), left_shot / max(shot, 1e-30)
