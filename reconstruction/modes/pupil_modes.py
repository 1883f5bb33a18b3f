"""Pupil modes R_p, in which a wavefront is written: phi(u) = sum_p e_p R_p(u)."""

from dataclasses import dataclass

import numpy as np

from reconstruction.arrays import Floats, Image, Mask
from reconstruction.geometry import Sensor, centered_steps
from reconstruction.modes.legendre import legendre, legendre_lenslet_gradients, legendre_orders, legendre_products
from reconstruction.modes.zernike import noll_orders, zernike, zernike_lenslet_gradients, zernike_products
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
    half_x_m, half_y_m = sensor.pupil_half_width_m
    if basis == "legendre":
        return PupilModes(
            values=legendre(count, sensor.pupil_x_m / half_x_m, sensor.pupil_y_m[:, None] / half_y_m),
            gradients=legendre_lenslet_gradients(count, rows, columns) / sensor.pupil_half_width_m,
            inside=np.ones((rows, columns), np.bool_),
            degree=np.asarray(np.sum(legendre_orders(count), axis=1), np.float64),
            products=legendre_products(count),
        )
    radius_m = min(half_x_m, half_y_m)
    x, y = sensor.pupil_x_m / radius_m, sensor.pupil_y_m[:, None] / radius_m
    edges_x, edges_y = (
        centered_steps(lenslets + 1) * sensor.lenslet_pitch_m / radius_m for lenslets in (columns, rows)
    )
    degree = np.array([n for n, _ in noll_orders(count)], np.float64)
    return PupilModes(
        values=zernike(count, x, y),
        gradients=zernike_lenslet_gradients(count, edges_x, edges_y) / radius_m,
        inside=np.asarray(x**2 + y**2 <= 1),
        degree=degree,
        products=zernike_products(count, half_x_m / radius_m, half_y_m / radius_m),
    )


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
