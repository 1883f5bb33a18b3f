"""Pupil modes R_p, in which a wavefront is written: phi(u) = sum_p e_p R_p(u)."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from reconstruction.arrays import Floats, Image, Mask
from reconstruction.geometry import Sensor, centered_steps
from reconstruction.modes.legendre import (
    legendre,
    legendre_gradients,
    legendre_lenslet_gradients,
    legendre_orders,
    legendre_products,
)
from reconstruction.modes.zernike import (
    noll_orders,
    zernike,
    zernike_gradients,
    zernike_lenslet_gradients,
    zernike_products,
)
from reconstruction.settings import PupilBasis

_HIGHEST_DEGREE = 16  # highest for which the mean gradients of both bases are exact


@dataclass(frozen=True, slots=True, eq=False)
class PupilModes:
    """The modes R_p on the lenslets of a sensor, piston first."""

    values: Floats  # at the lenslet centres, (pupil_mode, lenslet_row, lenslet_column)
    gradients: Floats  # mean over each lenslet, 1/m, (pupil_mode, lenslet_row, lenslet_column, xy)
    inside: Mask  # lenslets inside the pupil, (lenslet_row, lenslet_column)
    degree: Floats  # of the polynomial, (pupil_mode,)
    products: Floats  # R_p as a sum of products P_m(xi) P_n(eta): (pupil_mode, n, m), xi, eta over the whole lattice


def pupil_modes(sensor: Sensor, basis: PupilBasis, count: int | None) -> PupilModes:
    """Legendre modes over the whole lattice, or Zernike modes over its inscribed circle.

    A lenslet is inside the circle if its centre is; its gradients are means over the whole lenslet. Without a `count`,
    all modes of a degree below the number of lenslets a side, and at most 16.
    """
    rows, columns = sensor.lenslet_rows, sensor.lenslet_columns
    if count is None:
        highest = min(rows - 1, columns - 1, _HIGHEST_DEGREE)
        count = (highest + 1) * (highest + 2) // 2
    half_m, centers_m = np.array(sensor.pupil_half_width_m), sensor.lenslet_centers_m
    if basis == "legendre":
        if sensor.arrangement == "square":
            gradients = legendre_lenslet_gradients(count, rows, columns)
        else:
            gradients = _hexagon_means(partial(legendre_gradients, count), sensor, half_m)
        return PupilModes(
            values=legendre(count, *np.moveaxis(centers_m / half_m, -1, 0)),
            gradients=gradients / half_m,
            inside=np.ones((rows, columns), np.bool_),
            degree=np.asarray(np.sum(legendre_orders(count), axis=1), np.float64),
            products=legendre_products(count),
        )
    radius_m = half_m.min()
    x, y = np.moveaxis(centers_m / radius_m, -1, 0)
    if sensor.arrangement == "square":
        edges_x, edges_y = (
            centered_steps(lenslets + 1) * sensor.lenslet_pitch_m / radius_m for lenslets in (columns, rows)
        )
        gradients = zernike_lenslet_gradients(count, edges_x, edges_y)
    else:
        gradients = _hexagon_means(partial(zernike_gradients, count), sensor, np.full(2, radius_m))
    degree = np.array([n for n, _ in noll_orders(count)], np.float64)
    return PupilModes(
        values=zernike(count, x, y),
        gradients=gradients / radius_m,
        inside=np.asarray(x**2 + y**2 <= 1),
        degree=degree,
        products=zernike_products(count, *(half_m / radius_m)),
    )


def _hexagon_means(gradients: Callable[[Floats, Floats], Floats], sensor: Sensor, unit_m: Floats) -> Floats:
    """Means over hexagonal lenslets of gradients (mode, *shape, xy) at positions in `unit_m` (xy,).

    The Gauss-Legendre rule, along x and between the edges along y, is exact up to degree 16 of the modes.
    """
    nodes, weights = np.polynomial.legendre.leggauss(_HIGHEST_DEGREE // 2 + 1)
    along = (nodes + 1) / 4  # of the right half, in pitches
    edge = (1 - along) / math.sqrt(3)  # upper one
    centers_m, total = sensor.lenslet_centers_m, 0.0
    area = 4 * float(weights @ edge)
    for x, height, share in zip((*along, *-along), (*edge, *edge), (*weights, *weights), strict=True):
        for node, weight in zip(nodes, weights, strict=True):
            at = (centers_m + np.array([x, height * node]) * sensor.lenslet_pitch_m) / unit_m
            total = total + share * height * weight / area * gradients(at[..., 0], at[..., 1])
    return np.asarray(total)


class PupilGrid:
    """Evaluates wavefronts on a grid of pupil positions, prepared once."""

    def __init__(self, modes: PupilModes, sensor: Sensor, x_m: Floats, y_m: Floats) -> None:
        """Prepare for all combinations of the pupil positions x_m (x,) and y_m (y,)."""
        half_x_m, half_y_m = sensor.pupil_half_width_m
        highest = modes.products.shape[1] - 1
        self._products = modes.products
        self._along_x = np.polynomial.legendre.legvander(x_m / half_x_m, highest).T.astype(np.float32)
        self._along_y = np.polynomial.legendre.legvander(y_m / half_y_m, highest).astype(np.float32)

    def __call__(self, coefficients: Floats) -> Image:
        """Phase (y, x), rad, of a wavefront with the `coefficients` (pupil_mode,), rad."""
        products = np.tensordot(coefficients, self._products, axes=1).astype(np.float32)
        return np.asarray(self._along_y @ (products @ self._along_x), np.float32)
