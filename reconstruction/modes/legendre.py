"""Two-dimensional Legendre polynomials in the paper's order and their gradients, and projections on them.

L_k(x, y) = P_m(x) P_n(y) with k = (m + n)(m + n + 1)/2 + n (Feng et al.): k = 0 is the piston, 1 = x, 2 = y,
3 = P_2(x), 4 = xy, 5 = P_2(y). P_m is the ordinary Legendre polynomial with P_m(1) = 1.
"""

import numpy as np
from numpy.polynomial import legendre as series
from numpy.typing import ArrayLike, NDArray

from reconstruction.arrays import Floats


def legendre_orders(count: int) -> tuple[tuple[int, int], ...]:
    """Orders (m, n) of the first `count` polynomials: m along x, n along y."""
    orders: list[tuple[int, int]] = []
    degree = 0
    while len(orders) < count:
        orders += [(degree - n, n) for n in range(degree + 1)]
        degree += 1
    return tuple(orders[:count])


def legendre_names(count: int) -> tuple[str, ...]:
    """Number, from 0, and name of the first `count` polynomials, such as "L4 P1(x) P1(y)"."""
    return tuple(
        f"L{k} {' '.join(f'P{order}({axis})' for order, axis in ((m, 'x'), (n, 'y')) if order) or 'piston'}"
        for k, (m, n) in enumerate(legendre_orders(count))
    )


def legendre_products(count: int) -> Floats:
    """First `count` polynomials as products P_m(x) P_n(y): 1 at (k, n, m), (count, degree + 1, degree + 1)."""
    m, n, degree = _order_arrays(count)
    products = np.zeros((count, degree + 1, degree + 1))
    products[np.arange(count), n, m] = 1.0
    return products


def legendre(count: int, x: ArrayLike, y: ArrayLike) -> Floats:
    """First `count` polynomials at (x, y), normalised to [-1, 1]: (count, *broadcast shape)."""
    m, n, degree = _order_arrays(count)
    along_x, along_y = (_values(at, degree) for at in np.broadcast_arrays(x, y))
    return along_x[m] * along_y[n]


def legendre_gradients(count: int, x: ArrayLike, y: ArrayLike) -> Floats:
    """Gradients of the first `count` polynomials at (x, y), per unit of x and y: (count, *broadcast shape, xy)."""
    m, n, degree = _order_arrays(count)
    x, y = np.broadcast_arrays(x, y)
    along_x, along_y = _values(x, degree), _values(y, degree)
    slope_x, slope_y = (_first_axis(legendre_slopes(at.ravel(), degree), at.shape) for at in (x, y))
    return np.stack([slope_x[m] * along_y[n], along_x[m] * slope_y[n]], axis=-1)


def legendre_slopes(x: Floats, degree: int) -> Floats:
    """Derivatives of P_0 ... P_degree at x: (*shape of x, degree + 1), as NumPy's `legvander` has the values."""
    derive = series.legder(np.eye(degree + 1))
    return np.asarray(series.legvander(x, len(derive) - 1) @ derive)


def legendre_projection(degree: int, exact: int) -> tuple[Floats, Floats]:
    """Projection of functions on P_0 ... P_degree from nodes in [-1, 1]: nodes (node,), weights (node, degree + 1).

    It is exact for polynomials up to the degree `exact`.
    """
    nodes, weights = series.leggauss((exact + degree) // 2 + 1)
    return nodes, series.legvander(nodes, degree) * weights[:, None] * (np.arange(degree + 1) + 0.5)


def _order_arrays(count: int) -> tuple[list[int], list[int], int]:
    orders = legendre_orders(count)
    return [m for m, _ in orders], [n for _, n in orders], max(m + n for m, n in orders)


def _values(x: Floats, degree: int) -> Floats:
    """P_0 ... P_degree at x: (degree + 1, *shape of x)."""
    return _first_axis(series.legvander(np.asarray(x, np.float64).ravel(), degree), x.shape)


def _first_axis(values: NDArray[np.floating], shape: tuple[int, ...]) -> Floats:
    return np.asarray(np.moveaxis(values, -1, 0).reshape(-1, *shape), np.float64)
