"""Compiled inner loop of the registration: sampling a frame where a warped window lands.

A warp is a pair of quartic polynomials, for x and for y, of the normalised position (u, v) in the window.

Loops over the pixels of a window begin at 0, and indices of pixels are 32 bits wide: from other beginnings Numba allows
for negative indices, and the processor then handles fewer pixels at a time.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias, cast

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from reconstruction.arrays import Floats, Image
from reconstruction.runtime.compilation import FAST_MATH, compiled, inlined

MONOMIALS = tuple((degree - n, n) for degree in range(5) for n in range(degree + 1))  # powers of u and v
_ONE, _TWO, _THREE, _FOUR, _HALF = (np.float32(value) for value in (1, 2, 3, 4, 0.5))
_SIXTH, _TWO_THIRDS = np.float32(1 / 6), np.float32(2 / 3)
_FOUR_FLOATS, _INDEX = ir.VectorType(ir.FloatType(), 4), ir.IntType(32)
# Of a cubic B-spline's weights of four neighbours at the pixel fraction t: coefficients of t^3, t^2, t and 1.
_SPLINE = ((-1 / 6, 1 / 2, -1 / 2, 1 / 6), (1 / 2, -1, 1 / 2, 0), (-1 / 2, 0, 1 / 2, 0), (1 / 6, 2 / 3, 1 / 6, 0))

Terms: TypeAlias = tuple[np.float32, ...]  # coefficients of a polynomial, in the order of `MONOMIALS`


class Window(NamedTuple):
    """Pixels of a window about a lenslet, row by row, in normalised positions, (N,)."""

    u: Image
    v: Image


def window_of(pixels: NDArray[np.bool_], steps: NDArray[np.floating[Any]]) -> Window:
    """Window of some pixels (row, column); `steps` are the normalised positions of columns, and of rows."""
    row, column = np.nonzero(pixels)
    return Window(steps[column].astype(np.float32), steps[row].astype(np.float32))


class Scratch(NamedTuple):
    """One thread's work arrays for the N pixels of a window, and for P parameters."""

    x: Image  # position of each pixel on the camera, px, (N,)
    y: Image
    light: Image  # of the frame there, counts, (N,)
    stretch: Image  # determinant of the warp, (N,)
    left: NDArray[np.int32]  # column and row of the pixel before that position, (N,)
    above: NDArray[np.int32]
    weights: Image  # of the four rows of coefficients about it, (4, N)
    fraction: Image  # of a pixel, along x, (N,)
    residual: Image  # counts, (N,)
    excluded: NDArray[np.bool_]  # excluded pixels, (N,)
    warp: Image  # of the displacement, (xy, monomial)
    placed: Image  # the same on the camera, (xy, monomial)
    change: Image  # of the parameters, (P,)
    equations: Floats  # of the parameters, if pixels are excluded, and those being solved, (2, P, P)


def new_scratch(pixels: int, parameters: int) -> Scratch:
    """Allocate work arrays for windows of that many pixels and that many parameters."""
    x, y, light, stretch, fraction, residual = np.ones((6, pixels), np.float32)
    left, above = np.empty((2, pixels), np.int32)
    return Scratch(
        x=x,
        y=y,
        light=light,
        stretch=stretch,
        left=left,
        above=above,
        weights=np.empty((4, pixels), np.float32),
        fraction=fraction,
        residual=residual,
        excluded=np.empty(pixels, np.bool_),
        warp=np.empty((2, len(MONOMIALS)), np.float32),
        placed=np.empty((2, len(MONOMIALS)), np.float32),
        change=np.empty(parameters, np.float32),
        equations=np.empty((2, parameters, parameters)),
    )


@inlined
def combine(parameters: Image, monomials: Image, warp: Image) -> None:
    """Compute the polynomials (xy, monomial) of a displacement with the parameters (P,)."""
    for axis in range(2):
        for m in range(warp.shape[1]):
            warp[axis, m] = 0
            for p in range(parameters.size):
                warp[axis, m] += parameters[p] * monomials[p, axis, m]


@inlined
def warp_value(p: Image | Terms, u: np.float32, v: np.float32) -> np.float32:
    """Value of one polynomial (monomial,) at (u, v)."""
    value: np.float32 = (
        p[0]
        + v * (p[2] + v * (p[5] + v * (p[9] + v * p[14])))
        + u * (p[1] + v * (p[4] + v * (p[8] + v * p[13])))
        + u * u * (p[3] + v * (p[7] + v * p[12]) + u * (p[6] + v * p[11] + u * p[10]))
    )
    return value


@inlined
def _is_quadratic(p: Terms) -> bool:
    """True if the terms of higher degree are 0."""
    return bool(p[6] == p[7] == p[8] == p[9] == p[10] == p[11] == p[12] == p[13] == p[14] == 0)


@inlined
def _quadratic_value(p: Terms, u: np.float32, v: np.float32) -> np.float32:
    """Value of a quadratic polynomial at (u, v)."""
    value: np.float32 = p[0] + v * (p[2] + v * p[5]) + u * (p[1] + v * p[4] + u * p[3])
    return value


@inlined
def _slopes(p: Terms, u: np.float32, v: np.float32) -> tuple[np.float32, np.float32]:
    """Derivatives of a polynomial with respect to u and v."""
    along = p[1] + v * (p[4] + v * (p[8] + v * p[13]))
    along += u * (_TWO * (p[3] + v * (p[7] + v * p[12])) + u * (_THREE * (p[6] + v * p[11]) + u * _FOUR * p[10]))
    across = p[2] + v * (_TWO * p[5] + v * (_THREE * p[9] + v * _FOUR * p[14]))
    across += u * (p[4] + v * (_TWO * p[8] + v * _THREE * p[13]) + u * (p[7] + v * _TWO * p[12] + u * p[11]))
    return along, across


@inlined
def _terms(p: Image) -> Terms:
    """Coefficients of a polynomial (monomial,) as numbers, which no write into an array changes."""
    return p[0], p[1], p[2], p[3], p[4], p[5], p[6], p[7], p[8], p[9], p[10], p[11], p[12], p[13], p[14]


@compiled
def sample_warped(
    coefficients: Image,
    window: Window,
    center_px: Floats,
    turn: Image,
    scale: tuple[np.float32, np.float32],
    scratch: Scratch,
) -> None:
    """Sample a frame where the warped pixels of a lenslet's window land.

    The warp is in `scratch`, which is filled. The frame is given by its spline coefficients (row, column); beyond its
    border the nearest inner position is sampled. center_px (xy,), turn (cosine, sine) and warp (xy, monomial), px,
    place the window. `scale`: px per unit of u and v, and its inverse to conserve flux or 0, which leaves the
    determinant at 1.
    """
    rows, columns = coefficients.shape
    last_x, last_y = np.float32(columns - 3), np.float32(rows - 3)
    x, y, left, above, weights = scratch.x, scratch.y, scratch.left, scratch.above, scratch.weights
    warp, placed, cosine, sine = scratch.warp, scratch.placed, turn[0], turn[1]
    for m in range(warp.shape[1]):
        along, across = warp[0, m], warp[1, m]
        if m == 1:
            along += scale[0]
        elif m == 2:
            across += scale[0]
        placed[0, m], placed[1, m] = cosine * along - sine * across, sine * along + cosine * across
    placed[0, 0] += np.float32(center_px[0])
    placed[1, 0] += np.float32(center_px[1])
    p, q = _terms(placed[0]), _terms(placed[1])
    if _is_quadratic(p) and _is_quadratic(q):
        for n in range(x.size):
            x[n] = min(max(_quadratic_value(p, window.u[n], window.v[n]), _ONE), last_x)
            y[n] = min(max(_quadratic_value(q, window.u[n], window.v[n]), _ONE), last_y)
    else:
        for n in range(x.size):
            x[n] = min(max(warp_value(p, window.u[n], window.v[n]), _ONE), last_x)
            y[n] = min(max(warp_value(q, window.u[n], window.v[n]), _ONE), last_y)
    if scale[1] > 0:
        p, q = _terms(warp[0]), _terms(warp[1])
        for n in range(x.size):
            x_u, x_v = _slopes(p, window.u[n], window.v[n])
            y_u, y_v = _slopes(q, window.u[n], window.v[n])
            scratch.stretch[n] = (_ONE + scale[1] * x_u) * (_ONE + scale[1] * y_v) - scale[1] * y_u * scale[1] * x_v
    for n in range(x.size):
        left[n], above[n] = np.int32(x[n]), np.int32(y[n])
        scratch.fraction[n], w = x[n] - np.float32(left[n]), y[n] - np.float32(above[n])
        r = _ONE - w
        weights[0, n], weights[3, n] = _SIXTH * r * r * r, _SIXTH * w * w * w
        weights[1, n] = _TWO_THIRDS - w * w * (_ONE - _HALF * w)
        weights[2, n] = _TWO_THIRDS - r * r * (_ONE - _HALF * r)
    _interpolate(coefficients.reshape(-1), np.uint64(columns), scratch)


@inlined
def _interpolate(flat: Image, stride: np.uint64, scratch: Scratch) -> None:
    """Interpolate the light from the flat coefficients about the pixels in `scratch`."""
    weights, light = scratch.weights, scratch.light
    for n in range(light.size):
        corner = np.uint64(scratch.above[n] - 1) * stride + np.uint64(scratch.left[n] - 1)
        above, at, below, beyond = weights[0, n], weights[1, n], weights[2, n], weights[3, n]
        light[n] = _neighbourhood_sum(flat, corner, stride, scratch.fraction[n], above, at, below, beyond)


def _sum_in_vectors(
    _context: Any, flat: Any, _corner: Any, _stride: Any, _fraction: Any, _w0: Any, _w1: Any, _w2: Any, _w3: Any
) -> Any:
    """Describe to Numba how to add four rows of four neighbours as vectors, not number by number."""

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
