"""Compiled loop over the lenslets: the starts of their fits, and the noise left by interpolation.

Threads share the lenslets without the interpreter lock: each takes the next until none is left. One that starts late,
because others hold the lock or the processor is busy, does not delay the others.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import Floats, Image
from reconstruction.registration.gauss_newton._alignment import LOST_PX, FrameData, Grid, State, fit_warp
from reconstruction.registration.gauss_newton._warped_sampling import Scratch, Window, new_scratch, sample_warped
from reconstruction.runtime.compilation import compiled, inlined
from reconstruction.runtime.counters import Counters, finish, is_finished, take

_NOISE_STRIDE = 7  # pixels between samples of the interpolation noise; no divisor of a window's width
_START_LIMITS = 8, np.float32(0.1)  # iterations and tolerance, px, of translations, which are only the start of warps
_ITERATIONS = 16  # of a warp
CONVERGED_PX = np.float32(0.05)  # largest last step of a converged fit
_GIVEN, _TRANSLATING, _TRANSLATED, _SEARCHED, _REPEATED, _DONE = range(6)  # from what a lenslet's fit starts


class WholePixelSearch(NamedTuple):
    """Whole-pixel search with the middle of the reference's windows, used when Gauss-Newton fails."""

    light: Image  # minus its mean, over its contrast, (L, rows, columns)
    window: Window  # a patch wider by `reach` pixels on each side
    scale: tuple[np.float32, np.float32]  # px per unit of u and v, and 0: no flux
    reach: int  # the largest shift, px


class FitLimits(NamedTuple):
    """Limits of convergence and match."""

    tolerance_px: Image  # of a warp, (L,)
    poor_square: Image  # squared residual beyond which to try another start, polynomial of the gain: (L, 3), counts^2


class Fits(NamedTuple):
    """Fits of L lenslets; filled in."""

    displacement: Image  # parameters; in: start of the fit, or NaN; out: the fit, px, (L, P - 2)
    contrast: Floats  # standard deviation of the frame's subimage at the start, counts, (L,)
    gain: Floats  # from the frame's light to the reference's, (L,)
    square: Floats  # weighted sum of the residual's squares after the last step, counts^2, (L,)
    step_px: Floats  # the largest change of a parameter in the last step, (L,)
    noise_power: Floats  # share of the noise that interpolation leaves: uniform, shot, (L, 2)
    is_partial: NDArray[np.bool_]  # some pixels were excluded, (L,)
    excluded: NDArray[np.bool_]  # pixels, (L, N)
    residual: Image  # after the last step but one, 0 in excluded pixels, counts, (L, N)


class Propagated(NamedTuple):
    """Effect of noise of a given variance per pixel on the fits of L lenslets with Q field modes."""

    covariance: Floats  # of the parameters, (L, P - 2, P - 2)
    square: Floats  # expected weighted sum of its squares, (L,)
    fitted: Floats  # part of `square` absorbed by the fit, (L,)
    trace: Floats  # sum of the parameters' variances, (L,)

    def replaced(self, lenslets: NDArray[np.intp], by: "Propagated") -> "Propagated":
        """The same with another effect on some lenslets (K,)."""
        arrays = [array.copy() for array in self]
        for array, some in zip(arrays, by, strict=True):
            array[lenslets] = some
        return Propagated(*arrays)


class WorkArrays(NamedTuple):
    """One thread's work arrays."""

    scratch: Scratch  # for warps
    coarse: Scratch  # for translations
    patch: Scratch  # for the whole-pixel search
    translation: Image  # px, (xy,)
    again: Image  # parameters of another fit, (P - 2,)


def new_work_arrays(grids: tuple[Grid, Grid], search: WholePixelSearch) -> WorkArrays:
    """Allocate the work arrays of one thread; see `fit_lenslets`."""
    coarse, scratch = (new_scratch(grid.window.u.size, grid.inverse.shape[1]) for grid in grids)
    patch = new_scratch(search.window.u.size, 0)
    return WorkArrays(scratch, coarse, patch, np.empty(2, np.float32), np.empty(len(grids[1].basis), np.float32))


@compiled
def fit_lenslets(  # noqa: C901, PLR0912, PLR0917 - called functions, inlined once more, compile to slower code
    frame: FrameData,
    grids: tuple[Grid, Grid],
    search: WholePixelSearch,
    limits: FitLimits,
    power: Image,
    fits: Fits,
    arrays: WorkArrays,
    counters: Counters,
) -> bool:
    """Fit lenslets, shared with the threads that have the same counters.

    False if others have not finished theirs. `grids` are the reference for translations on a coarse grid, and that for
    the warps. If these fail, the whole-pixel search gives another start. `power` (4,): see
    `spline.noise_power_polynomial`.
    """
    start, warp = grids
    scratch, coarse, patch, translation, again = arrays
    while True:
        lenslet = take(counters)
        if lenslet >= fits.gain.size:
            return is_finished(counters, fits.gain.size)
        if not warp.normal[lenslet, -1, -1] > 0:  # the sum of the weights
            fits.step_px[lenslet] = LOST_PX
            finish(counters)
            continue
        displacement, settled = fits.displacement[lenslet], (_ITERATIONS, limits.tolerance_px[lenslet])
        state = State(np.float32(np.inf), LOST_PX, np.float32(1.0), np.float32(0.0), False)
        translation[0] = translation[1] = 0
        stage = _GIVEN
        for p in range(displacement.size):
            if not np.isfinite(displacement[p]):
                stage = _TRANSLATING
        while stage != _DONE:  # one call for all fits: each is compiled anew, since all code is inlined
            grid, work, fitted, until = warp, scratch, displacement, settled
            if stage == _TRANSLATING:
                grid, work, fitted, until = start, coarse, translation, _START_LIMITS
            elif stage == _SEARCHED:
                fitted = again
            fit = fit_warp(frame, grid, lenslet, fitted, until, work)
            if stage == _TRANSLATING:
                if not max(abs(translation[0]), abs(translation[1])) < frame.half_cell_px:
                    translation[0] = translation[1] = 0
                _translate(displacement, translation[0], translation[1], warp.basis)
                stage = _TRANSLATED
            elif stage == _SEARCHED:
                is_converged = state.step_px < CONVERGED_PX
                stage = _REPEATED if is_converged else _DONE  # to restore the excluded pixels
                if fit.step_px < CONVERGED_PX and (fit.square < state.square or not is_converged):
                    for p in range(displacement.size):
                        displacement[p] = again[p]
                    state, stage = fit, _DONE
            else:
                state = fit
                poor = stage != _REPEATED and _is_poor(state, limits.poor_square[lenslet])
                if poor and stage == _GIVEN:
                    stage = _TRANSLATING
                elif poor and search.reach > 0:
                    x, y = _best_shift(frame, search, lenslet, patch)
                    _translate(again, x, y, warp.basis)
                    stage = _SEARCHED
                else:
                    stage = _DONE
        _note(state, scratch, fits, lenslet)
        light, weight = warp.light[lenslet], warp.weight[lenslet]
        _interpolated_noise(weight, light, power, scratch, fits.noise_power[lenslet])
        finish(counters)


@inlined
def _note(state: State, scratch: Scratch, fits: Fits, lenslet: int) -> None:
    """Note the fit of a lenslet."""
    fits.contrast[lenslet], fits.gain[lenslet] = state.contrast, state.gain
    fits.square[lenslet], fits.step_px[lenslet] = state.square, state.step_px
    fits.is_partial[lenslet] = state.is_partial
    for n in range(scratch.residual.size):
        fits.residual[lenslet, n] = scratch.residual[n]
    if state.is_partial:
        for n in range(scratch.excluded.size):
            fits.excluded[lenslet, n] = scratch.excluded[n]


@inlined
def _translate(displacement: Image, x: np.float32, y: np.float32, basis: Image) -> None:
    """Set parameters (P - 2,), of a basis (P - 2, 2Q), to those of a translation, px."""
    modes = basis.shape[1] // 2
    for p in range(displacement.size):
        displacement[p] = x * basis[p, 0] + y * basis[p, modes]


@inlined
def _is_poor(state: State, poor_square: Image) -> bool:
    """True if another start might do better."""
    enough = state.square < poor_square[0] + state.gain * (poor_square[1] + state.gain * poor_square[2])
    return not (state.step_px < CONVERGED_PX and enough)


@inlined
def _interpolated_noise(weight: Image, light: Image, power: Image, scratch: Scratch, found: Floats) -> None:
    """Mean share of the noise that interpolation leaves in a warped window: uniform, shot noise, (2,)."""
    pixels = shot = left_pixels = left_shot = np.float32(0)
    for n in range(0, weight.size, _NOISE_STRIDE):
        x = scratch.x[n] - np.float32(np.int32(scratch.x[n]))
        y = scratch.y[n] - np.float32(np.int32(scratch.y[n]))
        p, q = x * (np.float32(1) - x), y * (np.float32(1) - y)
        left = power[0] + p * (power[1] + p * (power[2] + p * power[3]))
        left *= power[0] + q * (power[1] + q * (power[2] + q * power[3]))
        shot_n = weight[n] * max(light[n], np.float32(0))
        pixels += weight[n]
        shot += shot_n
        left_pixels += weight[n] * left
        left_shot += shot_n * left
    found[0], found[1] = left_pixels / max(pixels, np.float32(1e-30)), left_shot / max(shot, np.float32(1e-30))


@inlined
def _best_shift(
    frame: FrameData, search: WholePixelSearch, lenslet: int, scratch: Scratch
) -> tuple[np.float32, np.float32]:
    """Whole-pixel shift (x, y) with the best correlation."""
    for axis in range(2):
        for m in range(scratch.warp.shape[1]):
            scratch.warp[axis, m] = 0
    sample_warped(frame.coefficients, search.window, frame.center_px[lenslet], frame.turn, search.scale, scratch)
    template, reach = search.light[lenslet], search.reach
    rows, columns = template.shape
    width = columns + 2 * reach
    patch = scratch.light
    pixels = np.float32(rows * columns)
    best, best_x, best_y = np.float32(0.0), 0, 0
    for shift_y in range(2 * reach + 1):
        for shift_x in range(2 * reach + 1):
            total, power, product = np.float32(0.0), np.float32(0.0), np.float32(0.0)
            for row in range(rows):
                first = (row + shift_y) * width + shift_x
                for column in range(columns):
                    value = patch[first + column]
                    total += value
                    power += value * value
                    product += value * template[row, column]
            spread = power - total * total / pixels
            if spread > 0 and product > best * np.sqrt(spread):  # the template's mean is 0: the patch's does not matter
                best, best_x, best_y = product / np.sqrt(spread), shift_x, shift_y
    return np.float32(best_x - reach), np.float32(best_y - reach)
