"""Compiled inner loop of the registration: sampling a frame where a warped window lands.

A warp is a pair of quartic polynomials, for x and for y, of the normalised position (u, v) in the window.

Loops over the pixels of a window begin at 0, and indices of pixels are 32 bits wide: from other beginnings Numba allows
for negative indices, and the processor then handles fewer pixels at a time.
"""

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple, TypeAlias, cast

import numpy as np
from llvmlite import ir
from numpy.typing import NDArray

from reconstruction.arrays import Floats, Image
from reconstruction.runtime.compilation import FAST_MATH, compiled, inlined
from reconstruction.runtime.compiler import intrinsic, types

MONOMIALS = tuple((degree - n, n) for degree in range(5) for n in range(degree + 1))  # powers of u and v
_ONE, _TWO, _THREE, _FOUR_TIMES = (np.float32(value) for value in (1, 2, 3, 4))
_AT_ONCE = 16  # pixels that are interpolated at a time; four times four neighbours are as many numbers
_INDEX, _ADDRESS = ir.IntType(32), ir.IntType(64)
_FOUR, _FLOATS = (ir.VectorType(ir.FloatType(), count) for count in (4, _AT_ONCE))
_INDICES = ir.VectorType(_INDEX, _AT_ONCE)
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
    residual: Image  # counts, (N,)
    excluded: NDArray[np.bool_]  # excluded pixels, (N,)
    warp: Image  # of the displacement, (xy, monomial)
    placed: Image  # the same on the camera, (xy, monomial)
    change: Image  # of the parameters, (P,)
    equations: Floats  # of the parameters, if pixels are excluded, and those being solved, (2, P, P)


def new_scratch(pixels: int, parameters: int) -> Scratch:
    """Allocate work arrays for windows of that many pixels and that many parameters."""
    room = -(-pixels // _AT_ONCE) * _AT_ONCE  # some are interpolated beyond the last one
    x, y, light, stretch, residual = np.ones((5, room), np.float32)[:, :pixels]
    return Scratch(
        x=x,
        y=y,
        light=light,
        stretch=stretch,
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
        total = warp[axis]
        for m in range(total.size):
            total[m] = 0
        for p in range(parameters.size):
            for m in range(total.size):
                total[m] += parameters[p] * monomials[p, axis, m]


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
    along += u * (_TWO * (p[3] + v * (p[7] + v * p[12])) + u * (_THREE * (p[6] + v * p[11]) + u * _FOUR_TIMES * p[10]))
    across = p[2] + v * (_TWO * p[5] + v * (_THREE * p[9] + v * _FOUR_TIMES * p[14]))
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
    x, y = scratch.x, scratch.y
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
    for first in range(0, x.size, _AT_ONCE):
        _interpolate(coefficients, np.int32(columns), x, y, first, scratch.light)


def _load(builder: Any, pointer: Any, kind: Any) -> Any:
    return builder.load(builder.bitcast(pointer, kind.as_pointer()), align=4)


def _picked(builder: Any, a: Any, b: Any, lanes: Iterable[int]) -> Any:
    """Numbers of two vectors one after the other."""
    chosen = [_INDEX(n) for n in lanes]
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(_INDEX, len(chosen)), chosen))


def _joined(builder: Any, a: Any, b: Any, c: Any, d: Any) -> Any:
    """One vector of four with four numbers each."""
    return _picked(builder, _picked(builder, a, b, range(8)), _picked(builder, c, d, range(8)), range(16))


def _add_product(builder: Any, total: Any, a: Any, b: Any) -> Any:
    return builder.fadd(total, builder.fmul(a, b, flags=FAST_MATH), flags=FAST_MATH)


def _cubic(builder: Any, t: Any, coefficients: Iterable[list[float]]) -> Any:
    """Cubic polynomials of t, each with its coefficients."""
    value, *others = (ir.Constant(_FLOATS, [float(np.float32(c)) for c in each]) for each in coefficients)
    for other in others:
        value = _add_product(builder, other, value, t)
    return value


def _parted(builder: Any, position: Any, first: Any) -> tuple[Any, Any]:
    """Pixels before some positions, and fractions of a pixel."""
    px = _load(builder, builder.gep(position, [first]), _FLOATS)
    whole = builder.fptosi(px, _INDICES)
    return whole, builder.fsub(px, builder.sitofp(whole, _FLOATS))


def _interpolate_in_vectors(_context: Any, image: Any, _columns: Any, x: Any, y: Any, _first: Any, light: Any) -> Any:
    """Describe to Numba how to interpolate 16 pixels from `first` on, in vectors of four pixels' four neighbours.

    Left to itself, the compiler adds number by number, or gathers neighbours one by one.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data, x, y, light = (
            context.make_array(signature.args[n])(context, builder, arguments[n]).data for n in (0, 2, 3, 5)
        )
        columns, first = arguments[1], arguments[4]
        (left, along), (above, across) = _parted(builder, x, first), _parted(builder, y, first)
        one = ir.Constant(_INDICES, [1] * _AT_ONCE)
        stride = _picked(builder, builder.insert_element(one, columns, _INDEX(0)), one, [0] * _AT_ONCE)
        corner = builder.add(builder.mul(builder.sub(above, one), stride), builder.sub(left, one))
        weights = [_cubic(builder, across, [[c[row]] * _AT_ONCE for c in _SPLINE]) for row in range(4)]
        steps = [builder.zext(builder.mul(columns, _INDEX(row)), _ADDRESS) for row in range(4)]
        found = []
        for pixels in (range(n, n + 4) for n in range(0, _AT_ONCE, 4)):
            places = [builder.zext(builder.extract_element(corner, _INDEX(n)), _ADDRESS) for n in pixels]
            corners = [builder.gep(data, [place]) for place in places]
            repeated = [n for n in pixels for _ in range(4)]
            total = ir.Constant(_FLOATS, [0.0] * _AT_ONCE)
            for step, weight in zip(steps, weights, strict=True):
                row = _joined(builder, *(_load(builder, builder.gep(each, [step]), _FOUR) for each in corners))
                total = _add_product(builder, total, row, _picked(builder, weight, weight, repeated))
            of_columns = _cubic(builder, _picked(builder, along, along, repeated), [[*c] * 4 for c in _SPLINE])
            total = builder.fmul(total, of_columns, flags=FAST_MATH)
            for distance in (1, 2):
                other = _picked(builder, total, total, [n ^ distance for n in range(_AT_ONCE)])
                total = builder.fadd(total, other, flags=FAST_MATH)
            found.append(_picked(builder, total, total, range(0, _AT_ONCE, 4)))
        place = builder.bitcast(builder.gep(light, [first]), _FLOATS.as_pointer())
        builder.store(_joined(builder, *found), place, align=4)
        return context.get_dummy_value()

    return types.void(image, types.int32, x, y, types.intp, light), generate


_interpolate = cast("Callable[..., None]", intrinsic(_interpolate_in_vectors))
