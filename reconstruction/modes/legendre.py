"""Two-dimensional Legendre polynomials in the paper's order, their gradients, and exact means over lenslets.

L_k(x, y) = P_m(x) P_n(y) with k = (m + n)(m + n + 1)/2 + n (Feng et al.): k = 0 is the piston, 1 = x, 2 = y,
3 = P_2(x), 4 = xy, 5 = P_2(y). P_m is the ordinary Legendre polynomial with P_m(1) = 1.
"""

import numpy as np
from numpy.polynomial import legendre as series
from numpy.typing import ArrayLike

from reconstruction.arrays import Floats


def legendre_orders(count: int) -> tuple[tuple[int, int], ...]:
    """Orders (m, n) of the first `count` polynomials: m along x, n along y."""
    orders: list[tuple[int, int]] = []
    degree = 0
    while len(orders) < count:
        orders += [(degree - n, n) for n in range(degree + 1)]
        degree += 1
    return tuple(orders[:count])


def legendre_products(count: int) -> Floats:
    """First `count` polynomials as products P_m(x) P_n(y): 1 at (k, n, m), (count, degree + 1, degree + 1)."""
    m, n, degree = _order_arrays(count)
    products = np.zeros((count, degree + 1, degree + 1))
    products[np.arange(count), n, m] = 1.0
    return products


def legendre(count: int, x: ArrayLike, y: ArrayLike) -> Floats:
    """First `count` polynomials at (x, y), normalised to [-1, 1]: (count, *broadcast shape)."""
    m, n, degree = _order_arrays(count)
    x, y = np.broadcast_arrays(x, y)
    return _values(x, degree)[m] * _values(y, degree)[n]


def legendre_gradients(count: int, x: ArrayLike, y: ArrayLike) -> Floats:
    """Gradients of the first `count` polynomials at (x, y), per unit of x and y: (count, *broadcast shape, xy)."""
    m, n, degree = _order_arrays(count)
    x, y = np.broadcast_arrays(x, y)
    along_x, along_y = _values(x, degree), _values(y, degree)
    slope_x, slope_y = _derivatives(x, degree), _derivatives(y, degree)
    return np.stack([slope_x[m] * along_y[n], along_x[m] * slope_y[n]], axis=-1)


def legendre_lenslet_gradients(count: int, lenslet_rows: int, lenslet_columns: int) -> Floats:
    """Exact mean gradient of each polynomial over each lenslet, per unit of the normalised pupil coordinates.

    The lenslets tile [-1, 1] x [-1, 1]. Shape (count, lenslet_row, lenslet_column, xy).
    """
    m, n, degree = _order_arrays(count)
    mean_x, slope_x = _cell_means(lenslet_columns, degree)
    mean_y, slope_y = _cell_means(lenslet_rows, degree)
    along_x = slope_x[m][:, None, :] * mean_y[n][:, :, None]
    along_y = mean_x[m][:, None, :] * slope_y[n][:, :, None]
    return np.stack([along_x, along_y], axis=-1)


def _order_arrays(count: int) -> tuple[list[int], list[int], int]:
    orders = legendre_orders(count)
    return [m for m, _ in orders], [n for _, n in orders], max(m + n for m, n in orders)


def _values(x: ArrayLike, degree: int) -> Floats:
    """P_0 ... P_degree at x: (degree + 1, *shape of x)."""
    x = np.asarray(x, np.float64)
    return np.moveaxis(series.legvander(x.ravel(), degree), -1, 0).reshape(degree + 1, *x.shape)


def _derivatives(x: ArrayLike, degree: int) -> Floats:
    """Derivatives of P_0 ... P_degree at x: (degree + 1, *shape of x)."""
    coefficients = series.legder(np.eye(degree + 1)) if degree else np.zeros((1, 1))
    return np.tensordot(coefficients.T, _values(x, coefficients.shape[0] - 1), axes=1)


def _cell_means(cells: int, degree: int) -> tuple[Floats, Floats]:
    """Means of P_0 ... P_degree and of their derivatives over `cells` equal parts of [-1, 1]: (degree + 1, cells)."""
    edges = np.linspace(-1.0, 1.0, cells + 1, dtype=np.float64)
    width = 2.0 / cells
    integrals: Floats = np.stack([series.legval(edges, series.legint(unit)) for unit in np.eye(degree + 1)])
    return np.diff(integrals, axis=1) / width, np.diff(_values(edges, degree), axis=1) / width
