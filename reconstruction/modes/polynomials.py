"""Legendre and Zernike polynomials of two variables, their gradients, names, and projections on them.

Legendre: L_k(x, y) = P_m(x) P_n(y) with k = (m + n)(m + n + 1)/2 + n (Feng et al.): k = 0 is the piston, 1 = x, 2 = y,
3 = P_2(x), 4 = xy, 5 = P_2(y). P_m is the ordinary Legendre polynomial with P_m(1) = 1.

Zernike, in Noll's order, counted from 0, with unit RMS over the unit circle: Z = N Q(x^2 + y^2) H(x, y), with H the
real or imaginary part of (x + iy)^m and r^m Q(r^2) the radial polynomial R_n^m: polynomials in x and y, without an
angle and without a singular centre (R. J. Noll, J. Opt. Soc. Am. 66, 207, 1976).
"""

import itertools
import math
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from numpy.polynomial import Polynomial
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
    """Projection on P_0 ... P_degree over [-1, 1]: nodes (node,) and weights (node, degree + 1).

    It is exact for polynomials up to the degree `exact`. The arrays are read-only.
    """
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


def zernike_names(count: int) -> tuple[str, ...]:
    """Number as Noll counts, from 1, and name of the first `count` modes, such as "Z4 defocus"."""
    return tuple(f"Z{j} {_NAMES.get((n, m), f'n = {n}, m = {m}')}" for j, (n, m) in enumerate(noll_orders(count), 1))


def zernike(count: int, x: ArrayLike, y: ArrayLike) -> Floats:
    """First `count` modes at (x, y), in units of the circle's radius: (count, *broadcast shape)."""
    x, y = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64))
    return np.stack([radial(x**2 + y**2) * part((x + 1j * y) ** m) for radial, m, part in _factors(count)])


def zernike_gradients(count: int, x: ArrayLike, y: ArrayLike) -> Floats:
    """Gradients of the first `count` modes at (x, y), per radius: (count, *broadcast shape, xy)."""
    x, y = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64))
    square, position = x**2 + y**2, x + 1j * y
    gradients = []
    for radial, m, part in _factors(count):
        outwards = 2 * radial.deriv()(square) * part(position**m)
        value, slope = radial(square), m * position ** max(m - 1, 0)  # the latter that of position**m
        along = [x * outwards + value * part(slope), y * outwards + value * part(1j * slope)]
        gradients.append(np.stack(along, axis=-1))
    return np.stack(gradients)


def zernike_products(count: int, half_x: float = 1.0, half_y: float = 1.0) -> Floats:
    """First `count` modes at (half_x xi, half_y eta) as sums of P_m(xi) P_n(eta): (count, n, m)."""
    degree = max(n for n, _ in noll_orders(count))
    nodes, parts = legendre_projection(degree, degree)
    values = zernike(count, nodes * half_x, nodes[:, None] * half_y)  # (count, y, x)
    return np.asarray(np.einsum("kyx,yn,xm->knm", values, parts, parts))


def zernike_projection(polynomials: Callable[[Floats, Floats], Floats], degree: int, count: int) -> Floats:
    """Coefficients of polynomials in the first `count` modes over the unit circle: (count, polynomial).

    `polynomials` returns values (polynomial, *shape) at x and y (*shape), in units of the circle's radius. The
    quadrature is exact up to their highest `degree`.
    """
    highest = degree + noll_orders(count)[-1][0]
    nodes, weights = np.polynomial.legendre.leggauss(highest // 4 + 1)  # in the squared radius
    radius, angle = np.sqrt((1 + nodes[:, None]) / 2), 2 * math.pi * np.arange(highest + 1) / (highest + 1)
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    weights = weights[:, None] / (2 * angle.size)
    return np.asarray(np.tensordot(zernike(count, x, y) * weights, polynomials(x, y), axes=((1, 2), (1, 2))))


def _factors(count: int) -> list[tuple[Polynomial, int, Any]]:
    """N Q of each mode as a polynomial in the squared radius; m, and the part of (x + iy)^m that is H."""
    factors = []
    for n, signed_m in noll_orders(count):
        m = abs(signed_m)
        coefficients = np.zeros((n - m) // 2 + 1)
        for k in range((n - m) // 2 + 1):
            sign = -1 if k % 2 else 1
            denominator = math.factorial(k) * math.factorial((n + m) // 2 - k) * math.factorial((n - m) // 2 - k)
            coefficients[(n - m) // 2 - k] = sign * math.factorial(n - k) / denominator
        norm = math.sqrt(n + 1) if m == 0 else math.sqrt(2 * (n + 1))
        factors.append((Polynomial(norm * coefficients), m, np.real if signed_m >= 0 else np.imag))
    return factors
