"""Compiled Gauss-Newton fit of one lenslet's warp from one start.

The steps use the inverse A prepared by `template`. Excluded pixels, n in B, are left out exactly by the down-dated
equations (1 - sum_B A_n J_n^T) x = sum_not-B A_n r_n, with J the steepest-descent images.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import Floats, Image
from reconstruction.registration.gauss_newton._warped_sampling import (
    Scratch,
    Window,
    combine,
    sample_warped,
    warp_value,
)
from reconstruction.runtime.compilation import inlined

LOST_PX = np.float32(1e6)  # last step of a lost fit

_BOUND_PX = np.float32(100.0)  # largest coefficient of a displacement; float32 resolves a fraction of a pixel below it
_GROWTH = np.float32(2.0)  # reject a step if the squared residual grows more; converging fits reach 1.5
_SMALL_PX = np.float32(0.1)  # smaller steps are never rejected
_LAST_PX = np.float32(0.04)  # larger steps are never the last one
_HALVINGS = 4
_SHRINKS = np.float32(0.3)  # step ratio, second to first, if the reference does not show all parameters
_SHRINKS_UNBENT = np.float32(0.02)  # step ratio when all parameters are visible: for a small displacement ...
_SHRINKS_PER_GRADIENT = np.float32(1.0)  # ... and its increase with the displacement's RMS gradient
_SHRINKS_LEAST = np.float32(0.15)  # of later steps: one parameter may settle before the others
_PIVOT = 1e-12  # of the elimination; below it the remaining pixels do not determine the displacement


class Grid(NamedTuple):
    """The reference for one warp: L lenslets, N pixels, Q field modes, P parameters, gain and offset last."""

    window: Window  # the pixels about the lenslet centre
    scale: tuple[np.float32, np.float32]  # px per unit of u and v; its inverse if flux is conserved, else 0
    monomials: Image  # the displacement of each parameter as polynomials of u and v, (P - 2, xy, monomial)
    basis: Image  # the same as coefficients (x modes, y modes), (P - 2, 2Q)
    light: Image  # I0, counts, (L, N)
    level: Image  # mean and standard deviation of I0, counts, (L, 2)
    inverse: NDArray[np.int16]  # A over its unit, (L, P, N): half the memory, whose reading limits the speed
    unit: Image  # of A, (L, P)
    descent: Image  # J, the steepest-descent images, (L, P, N)
    weight: Image  # of the pixels, 1 on average, 0 for unusable ones, (L, N)
    normal: Image  # J W J^T, (L, P, P)
    bend: Image  # mean squared gradient of each parameter's displacement over the field, per px^2, (P - 2,)
    is_gradient: bool  # the displacement is a gradient, of which the reference shows all parameters


class FrameData(NamedTuple):
    """A frame, and the position of the lattice on it."""

    coefficients: Image  # of the spline, (row, column)
    bad: NDArray[np.bool_]  # bad and saturated pixels, (row, column)
    sees_bad: NDArray[np.bool_]  # lenslets with such pixels in or next to their cell, (L,)
    center_px: Floats  # of the lenslets, (L, xy)
    turn: Image  # of the lattice, (cosine, sine)
    half_cell_px: np.float32  # beyond it is the neighbour's cell


class State(NamedTuple):
    """A fit and its quality."""

    square: np.float32  # weighted sum of the residual's squares after the last step, as if no pixel were excluded
    step_px: np.float32  # largest change of a parameter in the last step
    gain: np.float32
    contrast: np.float32  # standard deviation of the light at the start, counts
    is_partial: bool  # some pixels were excluded


@inlined
def fit_warp(  # noqa: C901, PLR0912 - one loop over the steps is what compiles to fast code
    frame: FrameData, grid: Grid, lenslet: int, displacement: Image, limits: tuple[int, np.float32], scratch: Scratch
) -> State:
    """Improve the displacement of one lenslet, given by its parameters (P - 2,), px, in place.

    `limits`: the number of iterations, and the tolerance, px. A step that increases the residual is halved; a fit that
    still increases it, or leaves all bounds, is lost. Gain and offset start from means and contrasts.
    """
    inverse, unit, change, limit = grid.inverse[lenslet], grid.unit[lenslet], scratch.change, _BOUND_PX
    step = np.float32(np.inf)
    gain, offset, contrast = np.float32(1.0), np.float32(0.0), np.float32(0.0)
    gain_before, offset_before, before, square = gain, offset, np.float32(np.inf), np.float32(np.inf)
    is_partial: bool = False
    renew, halvings, settled = True, 0, False
    for iteration in range(limits[0]):
        if not _largest(displacement) < limit:
            return State(np.float32(np.inf), LOST_PX, gain, contrast, is_partial)
        combine(displacement, grid.monomials, scratch.warp)
        sample_warped(frame.coefficients, grid.window, frame.center_px[lenslet], frame.turn, grid.scale, scratch)
        if iteration == 0:
            gain, offset, contrast = _brightness(scratch.light, grid.level[lenslet])
            gain_before, offset_before = gain, offset
            if not 0 < contrast < np.inf:  # dark, or overflow
                return State(np.float32(np.inf), LOST_PX, gain, np.float32(0.0), is_partial)
        if renew:
            edge = abs(grid.window.v[0])
            is_partial = bool(frame.sees_bad[lenslet]) or _leaves_cell(
                scratch.warp, edge, grid.scale[0], frame.half_cell_px
            )
            if is_partial:
                _exclude(frame, lenslet, scratch)
                _leave_out(inverse, unit, grid.descent[lenslet], scratch.excluded, scratch.equations[0])
        square = _subtract(gain, offset, grid.light[lenslet], grid.weight[lenslet], scratch)
        if is_partial:
            square = _zero_excluded(grid.weight[lenslet], scratch.excluded, scratch.residual)
        if not square < np.inf:
            return State(square, LOST_PX, gain, contrast, is_partial)
        if square > _GROWTH * before and step > _SMALL_PX:
            halvings += 1
            if halvings > _HALVINGS:
                return State(square, LOST_PX, gain, contrast, is_partial)
            for p in range(change.size):
                change[p] *= np.float32(0.5)
            for p in range(displacement.size):
                displacement[p] += change[p]
            step *= np.float32(0.5)
        else:
            before, gain_before, offset_before = square, gain, offset
            _project(inverse, unit, scratch.residual, change)
            if is_partial and not _solve(scratch.equations, change):
                return State(square, LOST_PX, gain, contrast, is_partial)
            last, step = step, np.float32(0.0)
            for p in range(displacement.size):
                displacement[p] -= change[p]
                step = max(step, abs(change[p]))
            shrinks = _SHRINKS if is_partial or not grid.is_gradient else _second_step(displacement, grid.bend)
            if iteration > 0:
                shrinks = min(max(step / last, min(shrinks, _SHRINKS_LEAST)), np.float32(0.9))
            # The remaining change, if the steps keep shrinking at this rate.
            settled = bool(step < _LAST_PX and step * shrinks / (np.float32(1.0) - shrinks) < limits[1])
        renew = bool(step > _SMALL_PX) or iteration == 0  # a fit between two sets of excluded pixels would never settle
        fainter = np.float32(1.0) - change[change.size - 2]
        gain, offset = gain_before * fainter, offset_before * fainter - change[change.size - 1]
        if settled:
            if not is_partial:
                square = max(square - _explained(grid.normal[lenslet], change), np.float32(0.0))
            break
    if not (gain > 0 and _largest(displacement) < limit):
        step = LOST_PX
    return State(square, step, gain, contrast, is_partial)


@inlined
def _largest(displacement: Image) -> np.float32:
    """Largest size of a parameter (P - 2,); infinite if one is not a number."""
    largest = np.float32(0.0)
    for p in range(displacement.size):
        if not abs(displacement[p]) <= largest:
            largest = abs(displacement[p]) if displacement[p] == displacement[p] else np.float32(np.inf)
    return largest


@inlined
def _second_step(displacement: Image, bend: Image) -> np.float32:
    """Expected ratio of the second step to the first, for a displacement with the parameters (P - 2,).

    The steps assume that a displaced subimage keeps its shape. On the screens of evidence/accuracy.md the ratio is at
    most twice the RMS gradient of the displacement, 1.1 times for most lenslets.
    """
    square = np.float32(0.0)
    for p in range(displacement.size):
        square += bend[p] * displacement[p] * displacement[p]
    return min(_SHRINKS_UNBENT + _SHRINKS_PER_GRADIENT * np.sqrt(square), _SHRINKS)


@inlined
def _explained(normal: Image, change: Image) -> np.float32:
    """Weighted sum of squares that a change of the parameters (P,) removes from the residual."""
    total = np.float32(0.0)
    for i in range(change.size):
        for j in range(change.size):
            total += change[i] * normal[i, j] * change[j]
    return total


@inlined
def _leaves_cell(warp: Image, edge: np.float32, per_unit: np.float32, half_cell_px: np.float32) -> bool:
    """True if a warp (xy, monomial) moves the window's border, at `edge`, into a neighbour's cell."""
    for row in range(-1, 2):
        for column in range(-1, 2):
            u, v = edge * np.float32(column), edge * np.float32(row)
            x, y = warp_value(warp[0], u, v) + u * per_unit, warp_value(warp[1], u, v) + v * per_unit
            if max(abs(x), abs(y)) > half_cell_px:
                return True
    return False


@inlined
def _brightness(light: Image, level: Image) -> tuple[np.float32, np.float32, np.float32]:
    """Gain and offset that give light (N,) the mean and contrast of the template; the light's contrast."""
    pixels = np.float32(light.size)
    mean = np.float32(0.0)
    for n in range(light.size):
        mean += light[n]
    mean /= pixels
    power = np.float32(0.0)
    for n in range(light.size):
        power += (light[n] - mean) * (light[n] - mean)
    contrast = np.sqrt(power / pixels)
    gain = level[1] / contrast
    return gain, level[0] - gain * mean, contrast


@inlined
def _subtract(gain: np.float32, offset: np.float32, template: Image, weight: Image, scratch: Scratch) -> np.float32:
    """Compute the residual; return its weighted sum of squares."""
    light, stretch, residual = scratch.light, scratch.stretch, scratch.residual
    square = np.float32(0.0)
    for n in range(light.size):
        residual[n] = (gain * light[n] + offset) * stretch[n] - template[n]
        square += weight[n] * residual[n] * residual[n]
    return square


@inlined
def _zero_excluded(weight: Image, excluded: NDArray[np.bool_], residual: Image) -> np.float32:
    """Zero the residual of excluded pixels; return the weighted sum of squares as if none were excluded."""
    square, total, kept = np.float32(0.0), np.float32(0.0), np.float32(0.0)
    for n in range(weight.size):
        total += weight[n]
        if excluded[n]:
            residual[n] = np.float32(0.0)
        else:
            kept += weight[n]
            square += weight[n] * residual[n] * residual[n]
    return square * total / max(kept, np.float32(1e-6))


@inlined
def _project(inverse: NDArray[np.int16], unit: Image, residual: Image, change: Image) -> None:
    """Project a residual (N,) to a change of the parameters (P,)."""
    for p in range(change.size):
        total, row = np.float32(0.0), inverse[p]
        for n in range(residual.size):
            total += np.float32(row[n]) * residual[n]
        change[p] = total * unit[p]


@inlined
def _exclude(frame: FrameData, lenslet: int, scratch: Scratch) -> None:
    """Exclude the pixels that land in a neighbour's cell or between bad pixels."""
    cosine, sine = frame.turn[0], frame.turn[1]
    for n in range(scratch.x.size):
        column, row = np.int32(scratch.x[n]), np.int32(scratch.y[n])
        along = scratch.x[n] - np.float32(frame.center_px[lenslet, 0])
        across = scratch.y[n] - np.float32(frame.center_px[lenslet, 1])
        beyond = max(abs(cosine * along + sine * across), abs(cosine * across - sine * along)) > frame.half_cell_px
        scratch.excluded[n] = beyond or (
            frame.sees_bad[lenslet]
            and (
                frame.bad[row, column]
                or frame.bad[row + 1, column]
                or frame.bad[row, column + 1]
                or frame.bad[row + 1, column + 1]
            )
        )


@inlined
def _leave_out(
    inverse: NDArray[np.int16], unit: Image, descent: Image, excluded: NDArray[np.bool_], equations: Floats
) -> None:
    """Compute the equations (P, P) without the excluded pixels (N,): 1 - sum A_n J_n^T over these."""
    parameters = inverse.shape[0]
    for i in range(parameters):
        for j in range(parameters):
            equations[i, j] = 1.0 if i == j else 0.0
    for n in range(excluded.size):
        if excluded[n]:
            for i in range(parameters):
                for j in range(parameters):
                    equations[i, j] -= unit[i] * np.float32(inverse[i, n]) * descent[j, n]


@inlined
def _copy(equations: Floats) -> None:
    """Copy the first of two (2, P, P) into the second, in which it is solved."""
    for i in range(equations.shape[1]):
        for j in range(equations.shape[1]):
            equations[1, i, j] = equations[0, i, j]


@inlined
def _solve(equations: Floats, x: Image) -> bool:
    """Solve M y = x by pivoted elimination, M the first of (2, P, P), x (P,) becoming y; False if M is singular."""
    _copy(equations)
    size, matrix = x.size, equations[1]
    for i in range(size):
        pivot_row = i
        for row in range(i + 1, size):
            if abs(matrix[row, i]) > abs(matrix[pivot_row, i]):
                pivot_row = row
        if not abs(matrix[pivot_row, i]) > _PIVOT:
            return False
        for column in range(i, size):
            matrix[i, column], matrix[pivot_row, column] = matrix[pivot_row, column], matrix[i, column]
        x[i], x[pivot_row] = x[pivot_row], x[i]
        for row in range(i + 1, size):
            factor = matrix[row, i] / matrix[i, i]
            for column in range(i, size):
                matrix[row, column] -= factor * matrix[i, column]
            x[row] -= np.float32(factor) * x[i]
    for i in range(size - 1, -1, -1):
        for column in range(i + 1, size):
            x[i] -= np.float32(matrix[i, column]) * x[column]
        x[i] /= np.float32(matrix[i, i])
    return True
