"""Compiled inner loop of the registration: sampling a frame where a warped window lands.

A warp is a pair of quartic polynomials, for x and for y, of the normalised position (u, v) in the window. In a row of
pixels v is constant, so that a few operations per pixel remain.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias, cast

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from reconstruction.arrays import Floats, Image
from reconstruction.runtime.compilation import FAST_MATH, compiled

MONOMIALS = tuple((degree - n, n) for degree in range(5) for n in range(degree + 1))  # powers of u and v
_ONE, _TWO, _THREE, _FOUR, _HALF = np.float32(1.0), np.float32(2.0), np.float32(3.0), np.float32(4.0), np.float32(0.5)
_SIXTH, _TWO_THIRDS = np.float32(1 / 6), np.float32(2 / 3)
_FOUR_FLOATS, _INDEX = ir.VectorType(ir.FloatType(), 4), ir.IntType(32)
# Of a cubic B-spline's weights of four neighbours at the pixel fraction t: coefficients of t^3, t^2, t and 1.
_SPLINE = ((-1 / 6, 1 / 2, -1 / 2, 1 / 6), (1 / 2, -1, 1 / 2, 0), (-1 / 2, 0, 1 / 2, 0), (1 / 6, 2 / 3, 1 / 6, 0))

Polynomial: TypeAlias = tuple[np.float32, np.float32, np.float32, np.float32, np.float32]  # rising powers of u


class Window(NamedTuple):
    """Pixels of a window about a lenslet, row by row, in normalised positions."""

    v: Image  # of its rows, (row,)
    first: NDArray[np.intp]  # index of the first pixel of each row, and their number, (row + 1,)
    u: Image  # of the pixels along their rows, (N,)


def window_of(pixels: NDArray[np.bool_], steps: NDArray[np.floating[Any]]) -> Window:
    """Window of some pixels (row, column); `steps` are the normalised positions of columns, and of rows."""
    rows = pixels.any(axis=1)
    first = np.concatenate([[0], np.cumsum(pixels[rows].sum(axis=1))]).astype(np.intp)
    return Window(steps[rows].astype(np.float32), first, steps[np.nonzero(pixels)[1]].astype(np.float32))


class Scratch(NamedTuple):
    """One thread's work arrays for the N pixels of a window."""

    x: Image  # position of each pixel on the camera, px, (N,)
    y: Image
    light: Image  # of the frame there, counts, (N,)
    stretch: Image  # determinant of the warp, (N,)
    corner: NDArray[np.uint32]  # flat index of the first of the 4 x 4 coefficients about it, (N,)
    weights: Image  # of the four rows of coefficients, (4, N)
    fraction: Image  # of a pixel, along x, (N,)
    residual: Image  # counts, (N,)
    excluded: NDArray[np.bool_]  # excluded pixels, (N,)


@compiled
def new_scratch(pixels: int) -> Scratch:
    """Allocate work arrays for windows of that many pixels."""
    return Scratch(
        np.empty(pixels, np.float32),
        np.empty(pixels, np.float32),
        np.empty(pixels, np.float32),
        np.ones(pixels, np.float32),
        np.empty(pixels, np.uint32),
        np.empty((4, pixels), np.float32),
        np.empty(pixels, np.float32),
        np.empty(pixels, np.float32),
        np.zeros(pixels, np.bool_),
    )


@compiled
def warp_polynomials(parameters: Image, monomials: Image) -> Image:
    """Polynomials (xy, monomial) of a displacement with some parameters (P,), those of each being `monomials`."""
    polynomials = np.zeros(monomials.shape[1:], np.float32)
    flat = polynomials.reshape(-1)
    for p in range(parameters.size):
        of_one = monomials[p].reshape(-1)
        for m in range(flat.size):
            flat[m] += parameters[p] * of_one[m]
    return polynomials


@compiled
def warp_value(p: Image, u: np.float32, v: np.float32) -> np.float32:
    """Value of one polynomial (monomial,) at (u, v)."""
    c0, c1, c2, c3, c4 = _along_row(p, v)
    value: np.float32 = c0 + u * (c1 + u * (c2 + u * (c3 + u * c4)))
    return value


@compiled
def _along_row(p: Image, v: np.float32) -> Polynomial:
    """Coefficients of a polynomial (monomial,) in powers of u at a given v."""
    return (
        p[0] + v * (p[2] + v * (p[5] + v * (p[9] + v * p[14]))),
        p[1] + v * (p[4] + v * (p[8] + v * p[13])),
        p[3] + v * (p[7] + v * p[12]),
        p[6] + v * p[11],
        p[10],
    )


@compiled
def _across_row(p: Image, v: np.float32) -> tuple[np.float32, np.float32, np.float32, np.float32]:
    """Coefficients of a polynomial's derivative with respect to v, in powers of u at a given v."""
    return (
        p[2] + v * (_TWO * p[5] + v * (_THREE * p[9] + v * _FOUR * p[14])),
        p[4] + v * (_TWO * p[8] + v * _THREE * p[13]),
        p[7] + v * _TWO * p[12],
        p[11],
    )


@compiled
def sample_warped(  # noqa: PLR0917 - compiled code takes its arguments by their place
    coefficients: Image,
    warp: Image,
    window: Window,
    center_px: Floats,
    turn: Image,
    scale: tuple[np.float32, np.float32],
    scratch: Scratch,
) -> None:
    """Sample a frame at the positions of the warped pixels of a lenslet's window; fill `scratch`.

    The frame is given by its spline coefficients (row, column); beyond its border the nearest inner position is
    sampled. center_px (xy,), turn (cosine, sine) and warp (xy, monomial), px, place the window. `scale`: px per unit of
    u and v, and its inverse to conserve flux or 0, which leaves the determinant at 1.
    """
    rows, columns = coefficients.shape
    last_x, last_y = np.float32(columns - 3), np.float32(rows - 3)
    x_all, y_all, stretch, weights = scratch.x, scratch.y, scratch.stretch, scratch.weights
    for row in range(window.v.size):
        v = window.v[row]
        (x0, x1, x2, x3, x4), (y0, y1, y2, y3, y4) = _camera_row(warp, v, center_px, turn, scale[0])
        first, beyond = window.first[row], window.first[row + 1]
        for n in range(first, beyond):
            u = window.u[n]
            x = x0 + u * (x1 + u * (x2 + u * (x3 + u * x4)))
            y = y0 + u * (y1 + u * (y2 + u * (y3 + u * y4)))
            x_all[n] = min(max(x, _ONE), last_x)
            y_all[n] = min(max(y, _ONE), last_y)
        if scale[1] > 0:
            s0, s1, s2, s3, s4, s5, s6 = _stretch_row(warp, v, scale[1])
            for n in range(first, beyond):
                u = window.u[n]
                stretch[n] = s0 + u * (s1 + u * (s2 + u * (s3 + u * (s4 + u * (s5 + u * s6)))))
    for n in range(x_all.size):
        left, above = np.int32(x_all[n]), np.int32(y_all[n])
        scratch.fraction[n], w = x_all[n] - np.float32(left), y_all[n] - np.float32(above)
        r = _ONE - w
        weights[0, n], weights[3, n] = _SIXTH * r * r * r, _SIXTH * w * w * w
        weights[1, n], weights[2, n] = (
            _TWO_THIRDS - w * w * (_ONE - _HALF * w),
            _TWO_THIRDS - r * r * (_ONE - _HALF * r),
        )
        scratch.corner[n] = np.uint32((above - 1) * columns + left - 1)
    _interpolate(coefficients.reshape(-1), np.uint64(columns), scratch)


@compiled
def _camera_row(
    warp: Image, v: np.float32, center_px: Floats, turn: Image, per_unit: np.float32
) -> tuple[Polynomial, Polynomial]:
    """Positions x and y on the camera, px, in the row at v of a warped window, in powers of u."""
    x0, x1, x2, x3, x4 = _along_row(warp[0], v)
    y0, y1, y2, y3, y4 = _along_row(warp[1], v)
    x1, y0 = x1 + per_unit, y0 + per_unit * v
    c, s = turn[0], turn[1]
    return (
        (
            c * x0 - s * y0 + np.float32(center_px[0]),
            c * x1 - s * y1,
            c * x2 - s * y2,
            c * x3 - s * y3,
            c * x4 - s * y4,
        ),
        (
            s * x0 + c * y0 + np.float32(center_px[1]),
            s * x1 + c * y1,
            s * x2 + c * y2,
            s * x3 + c * y3,
            s * x4 + c * y4,
        ),
    )


@compiled
def _stretch_row(
    warp: Image, v: np.float32, flux: np.float32
) -> tuple[np.float32, np.float32, np.float32, np.float32, np.float32, np.float32, np.float32]:
    """Determinant of a warp in the row at v, in powers of u: x_u y_v - y_u x_v."""
    _, x1, x2, x3, x4 = _along_row(warp[0], v)
    _, y1, y2, y3, y4 = _along_row(warp[1], v)
    a0, a1, a2, a3 = _across_row(warp[0], v)
    b0, b1, b2, b3 = _across_row(warp[1], v)
    x1, x2, x3, x4 = _ONE + flux * x1, _TWO * flux * x2, _THREE * flux * x3, _FOUR * flux * x4
    y1, y2, y3, y4 = flux * y1, _TWO * flux * y2, _THREE * flux * y3, _FOUR * flux * y4
    a0, a1, a2, a3 = flux * a0, flux * a1, flux * a2, flux * a3
    b0, b1, b2, b3 = _ONE + flux * b0, flux * b1, flux * b2, flux * b3
    return (
        x1 * b0 - y1 * a0,
        x1 * b1 + x2 * b0 - y1 * a1 - y2 * a0,
        x1 * b2 + x2 * b1 + x3 * b0 - y1 * a2 - y2 * a1 - y3 * a0,
        x1 * b3 + x2 * b2 + x3 * b1 + x4 * b0 - y1 * a3 - y2 * a2 - y3 * a1 - y4 * a0,
        x2 * b3 + x3 * b2 + x4 * b1 - y2 * a3 - y3 * a2 - y4 * a1,
        x3 * b3 + x4 * b2 - y3 * a3 - y4 * a2,
        x4 * b3 - y4 * a3,
    )


@compiled
def _interpolate(flat: Image, stride: np.uint64, scratch: Scratch) -> None:
    """Interpolate the light from the flat coefficients at the corners in `scratch`."""
    weights, light = scratch.weights, scratch.light
    for n in range(light.size):
        light[n] = _neighbourhood_sum(
            flat,
            np.uint64(scratch.corner[n]),
            stride,
            scratch.fraction[n],
            weights[0, n],
            weights[1, n],
            weights[2, n],
            weights[3, n],
        )


def _sum_in_vectors(
    _context: Any, flat: Any, _corner: Any, _stride: Any, _fraction: Any, _w0: Any, _w1: Any, _w2: Any, _w3: Any
) -> Any:
    """Describe to Numba, which would load number by number, how to add four rows of four neighbours as vectors."""

    def repeated(builder: Any, number: Any) -> Any:
        nothing = ir.Constant(_FOUR_FLOATS, ir.Undefined)
        first = builder.insert_element(nothing, number, _INDEX(0))
        return builder.shuffle_vector(first, nothing, ir.Constant(ir.VectorType(_INDEX, 4), [0] * 4))

    def sum_of(builder: Any, total: Any, a: Any, b: Any) -> Any:
        return builder.fadd(total, builder.fmul(a, b, flags=FAST_MATH), flags=FAST_MATH)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        corner, stride, fraction, *weights = arguments[1:]
        total = ir.Constant(_FOUR_FLOATS, [0.0] * 4)
        for weight in weights:
            row = builder.load(builder.bitcast(builder.gep(data, [corner]), _FOUR_FLOATS.as_pointer()), align=4)
            total = sum_of(builder, total, row, repeated(builder, weight))
            corner = builder.add(corner, stride)
        t = repeated(builder, fraction)
        cubic, *others = (ir.Constant(_FOUR_FLOATS, [float(np.float32(c)) for c in row]) for row in _SPLINE)
        for other in others:
            cubic = sum_of(builder, other, cubic, t)
        columns = builder.fmul(total, cubic, flags=FAST_MATH)
        a, b, c, d = (builder.extract_element(columns, _INDEX(n)) for n in range(4))
        return builder.fadd(builder.fadd(a, c, flags=FAST_MATH), builder.fadd(b, d, flags=FAST_MATH), flags=FAST_MATH)

    return types.float32(flat, types.uint64, types.uint64, *[types.float32] * 5), generate


_neighbourhood_sum = cast("Callable[..., np.float32]", intrinsic(_sum_in_vectors))
