"""Compiled inner loop of the registration: sampling a frame where a warped window lands.

A warp is a pair of cubic polynomials, for x and for y, of the normalised position (u, v) in the window, with the
monomials 1, u, v, u^2, uv, v^2, u^3, u^2 v, u v^2, v^3: a few operations per pixel.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import Floats, Image
from reconstruction.runtime.compilation import compiled

MONOMIALS = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3))  # powers of u and v
_ONE, _TWO, _THREE, _HALF = np.float32(1.0), np.float32(2.0), np.float32(3.0), np.float32(0.5)
_SIXTH, _TWO_THIRDS = np.float32(1 / 6), np.float32(2 / 3)
_NEXT, _NEXT_BUT_ONE, _LAST = np.uint64(1), np.uint64(2), np.uint64(3)  # columns of a 4 x 4 neighbourhood


class Scratch(NamedTuple):
    """One thread's work arrays for the N pixels of a window."""

    x: Image  # position of each pixel on the camera, px, (N,)
    y: Image
    light: Image  # of the frame there, counts, (N,)
    stretch: Image  # determinant of the warp, (N,)
    corner: NDArray[np.uint64]  # flat index of the first of the 4 x 4 coefficients about it, (N,)
    weights: Image  # of the four columns and the four rows of coefficients, (8, N)
    residual: Image  # counts, (N,)
    excluded: NDArray[np.bool_]  # excluded pixels, (N,)


@compiled
def new_scratch(pixels: int) -> Scratch:
    """Allocate work arrays for windows of that many pixels."""
    return Scratch(
        np.empty(pixels, np.float32),
        np.empty(pixels, np.float32),
        np.empty(pixels, np.float32),
        np.empty(pixels, np.float32),
        np.empty(pixels, np.uint64),
        np.empty((8, pixels), np.float32),
        np.empty(pixels, np.float32),
        np.zeros(pixels, np.bool_),
    )


@compiled
def warp_polynomials(displacement: Image, monomials: Image) -> Image:
    """Polynomials (xy, monomial) of a displacement (xy, Q) in the field modes `monomials` (Q, monomial)."""
    polynomials = np.zeros((2, monomials.shape[1]), np.float32)
    for axis in range(2):
        for q in range(monomials.shape[0]):
            for m in range(monomials.shape[1]):
                polynomials[axis, m] += displacement[axis, q] * monomials[q, m]
    return polynomials


@compiled
def warp_value(p: Image, u: np.float32, v: np.float32) -> np.float32:
    """Value of one polynomial (monomial,) at (u, v)."""
    along = p[2] + v * (p[5] + v * p[9])
    across = p[1] + v * (p[4] + v * p[8])
    value: np.float32 = p[0] + v * along + u * (across + u * (p[3] + v * p[7] + u * p[6]))
    return value


@compiled
def sample_warped(  # noqa: PLR0917 - compiled code takes its arguments by their place
    coefficients: Image,
    warp: Image,
    uv: Image,
    center_px: Floats,
    turn: Image,
    scale: tuple[np.float32, np.float32],
    scratch: Scratch,
) -> None:
    """Sample a frame at the positions of the warped pixels uv (xy, N) of a lenslet's window; fill `scratch`.

    The frame is given by its spline coefficients (row, column); beyond its border the nearest inner position is
    sampled. center_px (xy,), turn (cosine, sine) and warp (xy, monomial), px, place the window. `scale`: px per unit of
    u and v, and its inverse to conserve flux or 0.
    """
    per_unit, flux = scale
    rows, columns = coefficients.shape
    last_x, last_y = np.float32(columns - 3), np.float32(rows - 3)
    # Warp plus identity, in camera coordinates.
    to_x, to_y = np.empty(10, np.float32), np.empty(10, np.float32)
    for m in range(10):
        along_x, along_y = warp[0, m], warp[1, m]
        if m == 1:
            along_x += per_unit
        if m == 2:
            along_y += per_unit
        to_x[m], to_y[m] = turn[0] * along_x - turn[1] * along_y, turn[1] * along_x + turn[0] * along_y
    to_x[0] += np.float32(center_px[0])
    to_y[0] += np.float32(center_px[1])
    a, b = warp[0] * flux, warp[1] * flux
    u_all, v_all, x_all, y_all, weights = uv[0], uv[1], scratch.x, scratch.y, scratch.weights
    for n in range(x_all.size):
        u, v = u_all[n], v_all[n]
        x_all[n] = min(max(warp_value(to_x, u, v), _ONE), last_x)
        y_all[n] = min(max(warp_value(to_y, u, v), _ONE), last_y)
        xu = _ONE + a[1] + v * (a[4] + v * a[8]) + u * (_TWO * (a[3] + v * a[7]) + _THREE * u * a[6])
        xv = a[2] + u * (a[4] + u * a[7]) + v * (_TWO * (a[5] + u * a[8]) + _THREE * v * a[9])
        yu = b[1] + v * (b[4] + v * b[8]) + u * (_TWO * (b[3] + v * b[7]) + _THREE * u * b[6])
        yv = _ONE + b[2] + u * (b[4] + u * b[7]) + v * (_TWO * (b[5] + u * b[8]) + _THREE * v * b[9])
        scratch.stretch[n] = xu * yv - xv * yu
    for n in range(x_all.size):
        column, row = np.int32(x_all[n]), np.int32(y_all[n])
        t, w = x_all[n] - np.float32(column), y_all[n] - np.float32(row)
        s, r = _ONE - t, _ONE - w
        weights[0, n], weights[3, n] = _SIXTH * s * s * s, _SIXTH * t * t * t
        weights[1, n], weights[2, n] = (
            _TWO_THIRDS - t * t * (_ONE - _HALF * t),
            _TWO_THIRDS - s * s * (_ONE - _HALF * s),
        )
        weights[4, n], weights[7, n] = _SIXTH * r * r * r, _SIXTH * w * w * w
        weights[5, n], weights[6, n] = (
            _TWO_THIRDS - w * w * (_ONE - _HALF * w),
            _TWO_THIRDS - r * r * (_ONE - _HALF * r),
        )
        scratch.corner[n] = (row - 1) * columns + column - 1
    _interpolate(coefficients.reshape(-1), np.uint64(columns), scratch)


@compiled
def _interpolate(flat: Image, stride: np.uint64, scratch: Scratch) -> None:
    """Interpolate the light from the flat coefficients at the corners in `scratch`."""
    weights, light, corner = scratch.weights, scratch.light, scratch.corner
    for n in range(light.size):
        # Column by column, so that four neighbours of a row are one vector operation.
        a = corner[n]
        b, c, d = a + stride, a + stride + stride, a + stride + stride + stride
        y0, y1, y2, y3 = weights[4, n], weights[5, n], weights[6, n], weights[7, n]
        v0 = y0 * flat[a] + y1 * flat[b] + y2 * flat[c] + y3 * flat[d]
        v1 = y0 * flat[a + _NEXT] + y1 * flat[b + _NEXT] + y2 * flat[c + _NEXT] + y3 * flat[d + _NEXT]
        v2 = (
            y0 * flat[a + _NEXT_BUT_ONE]
            + y1 * flat[b + _NEXT_BUT_ONE]
            + y2 * flat[c + _NEXT_BUT_ONE]
            + y3 * flat[d + _NEXT_BUT_ONE]
        )
        v3 = y0 * flat[a + _LAST] + y1 * flat[b + _LAST] + y2 * flat[c + _LAST] + y3 * flat[d + _LAST]
        light[n] = (weights[0, n] * v0 + weights[1, n] * v1) + (weights[2, n] * v2 + weights[3, n] * v3)
