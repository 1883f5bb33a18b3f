"""The compiled inner loop of the registration: Gauss-Newton steps of one lenslet after another.

It releases the interpreter's lock, so that threads can share the lenslets; the mathematics is in `registration`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import ParamSpec, TypeVar, cast

import numba
import numpy as np

from reconstruction.geometry import Floats
from reconstruction.spline import Image

P = ParamSpec("P")
R = TypeVar("R")


def compiled(function: Callable[P, R]) -> Callable[P, R]:
    """Compile with Numba on the first call and keep the result on disk; a typed face for an untyped decorator."""
    compile_function = numba.njit(nogil=True, cache=True, fastmath={"contract", "reassoc", "nsz"}, error_model="numpy")
    return cast("Callable[P, R]", compile_function(function))


@compiled
def interpolate(coefficients: Image, x: np.float32, y: np.float32) -> np.float32:
    """Cubic B-spline value at (x, y); beyond the border the nearest inner position is taken."""
    one, half, sixth, two_thirds = np.float32(1.0), np.float32(0.5), np.float32(1 / 6), np.float32(2 / 3)
    x = min(max(x, one), np.float32(coefficients.shape[1] - 3))
    y = min(max(y, one), np.float32(coefficients.shape[0] - 3))
    column, row = int(x), int(y)
    t, v = x - np.float32(column), y - np.float32(row)
    s, w = one - t, one - v
    x0, x1 = sixth * s * s * s, two_thirds - t * t * (one - half * t)
    x2, x3 = two_thirds - s * s * (one - half * s), sixth * t * t * t
    y0, y1 = sixth * w * w * w, two_thirds - v * v * (one - half * v)
    y2, y3 = two_thirds - w * w * (one - half * w), sixth * v * v * v
    weights = (y0, y1, y2, y3)
    total = np.float32(0.0)
    for i in range(4):
        line = coefficients[row + i - 1]
        total += weights[i] * (
            x0 * line[column - 1] + x1 * line[column] + x2 * line[column + 1] + x3 * line[column + 2]
        )
    return total


@compiled
def align(  # noqa: C901, PLR0912, PLR0913, PLR0917 - one loop nest over plain arrays is what compiles to fast code
    coefficients: Image,
    first: int,
    last: int,
    center_px: Floats,
    offset_px: Image,
    turn: Image,
    basis: Image,
    template: Image,
    inverse: Image,
    weight: Image,
    iterations: int,
    tolerance_px: float,
    displacement: Image,
    contrast: Image,
    fitted_gain: Image,
    residual_square: Image,
    weighted_square: Image,
    last_step_px: Image,
) -> None:
    """Fit the displacement of lenslets `first` ... `last - 1`, in place.

    Of the frame: its spline coefficients (row, column). Of the lattice: center_px (L, xy) and its turn (cosine,
    sine). Of the reference: offset_px, basis, template, inverse and weight, as `template.Template` holds them. In and
    out: displacement (L, xy, Q), px. Out: contrast (L,), the standard deviation of the frame's subimage at the start;
    fitted_gain (L,); residual_square and weighted_square (L,), the sums of the residual's squares before the last
    step; last_step_px (L,), the largest change of a coefficient in it. Gain and offset start from the two subimages'
    means and contrasts.
    """
    modes, pixels = basis.shape[1], basis.shape[2]
    one = np.float32(1.0)
    warp = np.empty((6, pixels), np.float32)  # dx, dy, and their derivatives xx, xy, yx, yy
    residual = np.empty(pixels, np.float32)
    gain, offset = one, np.float32(0.0)
    for lenslet in range(first, last):
        for iteration in range(iterations):
            warp[:] = 0
            for q in range(modes):
                along_x, along_y = displacement[lenslet, 0, q], displacement[lenslet, 1, q]
                for n in range(pixels):
                    warp[0, n] += along_x * basis[0, q, n]
                    warp[1, n] += along_y * basis[0, q, n]
                for n in range(pixels):
                    warp[2, n] += along_x * basis[1, q, n]
                    warp[3, n] += along_x * basis[2, q, n]
                    warp[4, n] += along_y * basis[1, q, n]
                    warp[5, n] += along_y * basis[2, q, n]
            center_x, center_y = np.float32(center_px[lenslet, 0]), np.float32(center_px[lenslet, 1])
            square, weighted = np.float32(0.0), np.float32(0.0)
            for n in range(pixels):
                x, y = offset_px[n, 0] + warp[0, n], offset_px[n, 1] + warp[1, n]
                light = interpolate(
                    coefficients, center_x + turn[0] * x - turn[1] * y, center_y + turn[1] * x + turn[0] * y
                )
                stretch = (one + warp[2, n]) * (one + warp[5, n]) - warp[3, n] * warp[4, n]
                residual[n] = light * stretch
            if iteration == 0:
                contrast[lenslet] = residual.std()
                gain = template[lenslet].std() / max(contrast[lenslet], np.float32(1e-30))
                offset = template[lenslet].mean() - gain * residual.mean()
            for n in range(pixels):
                residual[n] = gain * residual[n] + offset - template[lenslet, n]
                square += residual[n] * residual[n]
                weighted += weight[lenslet, n] * residual[n] * residual[n]
            residual_square[lenslet], weighted_square[lenslet] = square, weighted
            step = np.float32(0.0)
            for q in range(modes):
                for axis in range(2):
                    change = np.float32(0.0)
                    row = inverse[lenslet, axis * modes + q]
                    for n in range(pixels):
                        change += row[n] * residual[n]
                    displacement[lenslet, axis, q] -= change
                    step = max(step, abs(change))
            gain_change, offset_change = np.float32(0.0), np.float32(0.0)
            for n in range(pixels):
                gain_change += inverse[lenslet, 2 * modes, n] * residual[n]
                offset_change += inverse[lenslet, 2 * modes + 1, n] * residual[n]
            gain *= one - gain_change
            offset -= offset_change
            last_step_px[lenslet], fitted_gain[lenslet] = step, gain
            if not step >= tolerance_px:  # converged, or no longer a number
                break
