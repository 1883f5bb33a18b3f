"""Legendre and Zernike polynomials of two variables, their gradients, names, and projections on them.

Legendre: L_k(x, y) = P_m(x) P_n(y) with k = (m + n)(m + n + 1)/2 + n (Feng et al.): k = 0 is the piston, 1 = x, 2 = y,
3 = P_2(x), 4 = xy, 5 = P_2(y). P_m is the ordinary Legendre polynomial with P_m(1) = 1.

Zernike, in Noll's order, counted from 0, with unit RMS over the unit circle: Z = Q(x^2 + y^2) H(x, y), with H the real
or imaginary part of (x + iy)^m: polynomials in x and y, without an angle and without a singular centre (R. J. Noll, J.
Opt. Soc. Am. 66, 207, 1976). Over an annulus, whose inner radius is the obscuration, they are the annular polynomials
of V. N. Mahajan (J. Opt. Soc. Am. 71, 75, 1981): r^m Q(r^2), orthonormal for each m.
"""

import itertools
import math
from collections.abc import Callable
from functools import cache
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.polynomial import Legendre
from numpy.polynomial import legendre as series
from numpy.typing import ArrayLike

from reconstruction.arrays import Floats


def number_up_to(degree: int) -> int:
    """Number of polynomials of two variables up to a degree."""
    return (degree + 1) * (degree + 2) // 2


def legendre_orders(count: int) -> tuple[tuple[int, int], ...]:
    """Orders (m, n) of the first `count` polynomials: m along x, n along y."""
    by_degree = ((degree - n, n) for degree in itertools.count() for n in range(degree + 1))
    return tuple(itertools.islice(by_degree, count))


def legendre_names(count: int) -> tuple[str, ...]:
    """Number, from 0, and name of the first `count` polynomials, such as "L4 P1(x) P1(y)"."""
    return tuple(
        f"L{k} {' '.join(f'P{order}({axis})' for order, axis in ((m, 'x'), (n, 'y')) if order) or 'piston'}"
        for k, (m, n) in enumerate(legendre_orders(count))
    )


def legendre_products(count: int) -> Floats:
    """First `count` polynomials as products P_m(x) P_n(y), (count, n, m): 1 at (k, n, m)."""
    m, n, degree = _order_arrays(count)
    products = np.zeros((count, degree + 1, degree + 1))
    products[np.arange(count), n, m] = 1.0
    return products


def legendre(count: int, x: ArrayLike, y: ArrayLike) -> Floats:
    """First `count` polynomials at (x, y), normalised to [-1, 1]: (count, *broadcast shape)."""
    m, n, degree = _order_arrays(count)
    along_x, along_y = (_of_each(series.legvander, at, degree) for at in np.broadcast_arrays(x, y))
    return along_x[m] * along_y[n]


def legendre_gradients(count: int, x: ArrayLike, y: ArrayLike) -> Floats:
    """Gradients of the first `count` polynomials at (x, y): (count, *broadcast shape, xy)."""
    m, n, degree = _order_arrays(count)
    (along_x, slope_x), (along_y, slope_y) = (
        [_of_each(of, at, degree) for of in (series.legvander, legendre_slopes)] for at in np.broadcast_arrays(x, y)
    )
    return np.stack([slope_x[m] * along_y[n], along_x[m] * slope_y[n]], axis=-1)


def legendre_slopes(x: Floats, degree: int) -> Floats:
    """Derivatives of P_0 ... P_degree at x, arranged as by `legvander`: (*shape of x, degree + 1)."""
    derive = series.legder(np.eye(degree + 1))
    return np.asarray(series.legvander(x, len(derive) - 1) @ derive)


@cache
def legendre_projection(degree: int, exact: int) -> tuple[Floats, Floats]:
    """Projection on P_0 ... P_degree: nodes (node,), weights (node, degree + 1), read-only; exact to degree `exact`."""
    nodes, weights = series.leggauss((exact + degree) // 2 + 1)
    project = series.legvander(nodes, degree) * weights[:, None] * (np.arange(degree + 1) + 0.5)
    nodes.flags.writeable = project.flags.writeable = False
    return nodes, project


def _order_arrays(count: int) -> tuple[list[int], list[int], int]:
    orders = legendre_orders(count)
    return [m for m, _ in orders], [n for _, n in orders], max(m + n for m, n in orders)


def _of_each(function: Callable[..., Any], x: Floats, degree: int) -> Floats:
    """Values of a function of P_0 ... P_degree at x: (degree + 1, *shape of x)."""
    return np.asarray(np.moveaxis(function(x.ravel(), degree), -1, 0).reshape(-1, *x.shape), np.float64)


_NAMES = {
    (0, 0): "piston",
    (1, 1): "tilt along x",
    (1, -1): "tilt along y",
    (2, 0): "defocus",
    (2, -2): "astigmatism at 45\N{DEGREE SIGN}",
    (2, 2): "astigmatism at 0\N{DEGREE SIGN}",
    (3, 1): "coma along x",
    (3, -1): "coma along y",
    (3, 3): "trefoil along x",
    (3, -3): "trefoil along y",
    (4, 0): "spherical aberration",
    (4, 2): "secondary astigmatism at 0\N{DEGREE SIGN}",
    (4, -2): "secondary astigmatism at 45\N{DEGREE SIGN}",
    (4, 4): "tetrafoil at 0\N{DEGREE SIGN}",
    (4, -4): "tetrafoil at 22.5\N{DEGREE SIGN}",
}

ZernikeOrder: TypeAlias = Literal["noll", "osa", "fringe"]
"""Numbering of Zernike modes: Noll's, from 1; OSA and ANSI Z80.28, from 0; fringe (Wyant and Creath), from 1."""

ORDERS: dict[ZernikeOrder, str] = {  # name and normalisation
    "noll": "Noll's order, unit RMS",
    "osa": "OSA/ANSI order, unit RMS",
    "fringe": "fringe order, unit amplitude",
}


def noll_orders(count: int) -> tuple[tuple[int, int], ...]:
    """Radial and azimuthal order (n, m) of the first `count` modes; m < 0 is the sine."""
    orders = []
    for n in range(count):
        index = n * (n + 1) // 2 + 1  # Noll's index of the first mode of radial order n
        for m in range(n % 2, n + 1, 2):
            for _ in range(1 if m == 0 else 2):  # a cosine where Noll's index is even, a sine where it is odd
                orders.append((n, m if m == 0 or index % 2 == 0 else -m))
                index += 1
    return tuple(orders[:count])


def zernike_numbers(count: int, order: ZernikeOrder) -> list[int]:
    """Numbers in an order of the first `count` modes in Noll's order."""
    orders = noll_orders(count)
    if order == "osa":
        return [(n * (n + 2) + m) // 2 for n, m in orders]
    if order == "fringe":
        return [(1 + (n + abs(m)) // 2) ** 2 - 2 * abs(m) + (m < 0) for n, m in orders]
    return list(range(1, count + 1))


def zernike_amplitudes(count: int) -> Floats:
    """Value at the edge of the circle of the first `count` modes of unit RMS, (count,); fringe modes have 1."""
    return np.sqrt([(n + 1) * (1 if m == 0 else 2) for n, m in noll_orders(count)])


def zernike_names(count: int, order: ZernikeOrder = "noll") -> tuple[str, ...]:
    """Number in an order and name of the first `count` modes in Noll's order, such as "Z4 defocus"."""
    numbers = zip(zernike_numbers(count, order), noll_orders(count), strict=True)
    return tuple(f"Z{number} {_NAMES.get((n, m), f'n = {n}, m = {m}')}" for number, (n, m) in numbers)


def zernike(count: int, x: ArrayLike, y: ArrayLike, obscuration: float = 0.0) -> Floats:
    """First `count` modes at (x, y), in units of the circle's radius: (count, *broadcast shape)."""
    x, y = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64))
    factors = _factors(count, obscuration)
    return np.stack([radial(x**2 + y**2) * part((x + 1j * y) ** m) for radial, m, part in factors])


def zernike_gradients(count: int, x: ArrayLike, y: ArrayLike) -> Floats:
    """Gradients of the first `count` modes at (x, y), per radius: (count, *broadcast shape, xy)."""
    x, y = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64))
    square, position = x**2 + y**2, x + 1j * y
    gradients = []
    for radial, m, part in _factors(count, 0.0):
        outwards = 2 * radial.deriv()(square) * part(position**m)
        value, slope = radial(square), m * position ** max(m - 1, 0)  # the latter that of position**m
        along = [x * outwards + value * part(slope), y * outwards + value * part(1j * slope)]
        gradients.append(np.stack(along, axis=-1))
    return np.stack(gradients)


def zernike_products(
    count: int,
    half_x: float = 1.0,
    half_y: float = 1.0,
    *,
    center: tuple[float, float] = (0.0, 0.0),
    obscuration: float = 0.0,
) -> Floats:
    """First `count` modes at (half_x xi, half_y eta) - center as sums of P_m(xi) P_n(eta): (count, n, m)."""
    degree = max(n for n, _ in noll_orders(count))
    nodes, parts = legendre_projection(degree, degree)
    x, y = nodes * half_x - center[0], nodes * half_y - center[1]
    values = zernike(count, x, y[:, None], obscuration)  # (count, y, x)
    return np.asarray(np.einsum("kyx,yn,xm->knm", values, parts, parts))


def zernike_projection(
    polynomials: Callable[[Floats, Floats], Floats], degree: int, count: int, obscuration: float = 0.0
) -> Floats:
    """Coefficients of polynomials in the first `count` modes over the circle or annulus: (count, polynomial).

    `polynomials` returns values (polynomial, *shape) at x and y (*shape), in units of the circle's radius. The
    quadrature is exact up to their highest `degree`.
    """
    highest = degree + noll_orders(count)[-1][0]
    nodes, weights = series.leggauss(highest // 4 + 1)  # in the squared radius
    radius, angle = np.sqrt(_square(nodes, obscuration)), 2 * math.pi * np.arange(highest + 1) / (highest + 1)
    x, y = radius[:, None] * np.cos(angle), radius[:, None] * np.sin(angle)
    values = zernike(count, x, y, obscuration) * weights[:, None] / (2 * angle.size)
    return np.asarray(np.tensordot(values, polynomials(x, y), axes=((1, 2), (1, 2))))


def _square(nodes: Floats, obscuration: float) -> Floats:
    """Squared radii for -1 ... 1, from the edge of the obscuration to that of the circle."""
    return np.asarray(1 - (1 - obscuration**2) * (1 - nodes) / 2)


def _factors(count: int, obscuration: float) -> list[tuple[Legendre, int, Any]]:
    """Q of each mode as a polynomial in the squared radius; m, and the part of (x + iy)^m that is H."""
    factors, highest = [], noll_orders(count)[-1][0]
    for n, signed_m in noll_orders(count):
        m = abs(signed_m)
        radial = _radial(m, (highest - m) // 2, obscuration)[(n - m) // 2]
        factors.append((radial, m, np.real if signed_m >= 0 else np.imag))
    return factors


@cache
def _radial(m: int, degree: int, obscuration: float) -> list[Legendre]:
    """Q_0 ... Q_degree of one m: r^m Q_k(r^2) are orthonormal over the squared radius, and positive at the edge."""
    nodes, weights = series.leggauss(degree + m // 2 + 1)
    root = np.sqrt(weights / 2 * _square(nodes, obscuration) ** m)
    triangle = np.linalg.qr(series.legvander(nodes, degree) * root[:, None], mode="r")
    coefficients = np.linalg.inv(triangle).T  # (k, Legendre polynomial)
    coefficients *= (1 if m == 0 else math.sqrt(2)) * np.sign(coefficients.sum(axis=1, keepdims=True))
    return [Legendre(each, (obscuration**2, 1.0)) for each in coefficients]
