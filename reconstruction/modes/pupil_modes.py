"""Pupil modes R_p, in which a wavefront is written: phi(u) = sum_p e_p R_p(u)."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.polynomial import legendre as series

from reconstruction.arrays import Floats, Image, Mask
from reconstruction.errors import ReconstructionError
from reconstruction.geometry import Arrangement, Sensor, centered_steps
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
    """Modes of one of the `BASES`, piston first.

    Without a `count`, all modes of a degree below the number of lenslets a side, and at most 16. `ReconstructionError`
    if there is no such basis.
    """
    if basis not in BASES:
        raise ReconstructionError(f"there is no basis {basis}: it must be {' or '.join(BASES)}")
    if count is None:
        highest = min(sensor.lenslet_rows - 1, sensor.lenslet_columns - 1, _HIGHEST_DEGREE)
        count = (highest + 1) * (highest + 2) // 2
    return BASES[basis](sensor, count)


def _legendre_modes(sensor: Sensor, count: int) -> PupilModes:
    """Legendre modes over the whole lattice."""
    rows, columns = sensor.lenslet_rows, sensor.lenslet_columns
    half_m, centers_m = np.array(sensor.pupil_half_width_m), sensor.lenslet_centers_m
    if sensor.arrangement == "square":
        gradients = legendre_lenslet_gradients(count, rows, columns)
    else:
        gradients = aperture_means(partial(legendre_gradients, count), sensor, half_m)
    return PupilModes(
        values=legendre(count, *np.moveaxis(centers_m / half_m, -1, 0)),
        gradients=gradients / half_m,
        inside=np.ones((rows, columns), np.bool_),
        degree=np.asarray(np.sum(legendre_orders(count), axis=1), np.float64),
        products=legendre_products(count),
    )


def _zernike_modes(sensor: Sensor, count: int) -> PupilModes:
    """Zernike modes over the circle inscribed in the lattice.

    A lenslet is inside the circle if its centre is; its gradients are means over the whole lenslet.
    """
    half_m = np.array(sensor.pupil_half_width_m)
    radius_m = half_m.min()
    x, y = np.moveaxis(sensor.lenslet_centers_m / radius_m, -1, 0)
    if sensor.arrangement == "square":
        edges_x, edges_y = (
            centered_steps(lenslets + 1) * sensor.lenslet_pitch_m / radius_m
            for lenslets in (sensor.lenslet_columns, sensor.lenslet_rows)
        )
        gradients = zernike_lenslet_gradients(count, edges_x, edges_y)
    else:
        gradients = aperture_means(partial(zernike_gradients, count), sensor, np.full(2, radius_m))
    return PupilModes(
        values=zernike(count, x, y),
        gradients=gradients / radius_m,
        inside=np.asarray(x**2 + y**2 <= 1),
        degree=np.array([n for n, _ in noll_orders(count)], np.float64),
        products=zernike_products(count, *(half_m / radius_m)),
    )


BASES: dict[PupilBasis, Callable[[Sensor, int], PupilModes]] = {"legendre": _legendre_modes, "zernike": _zernike_modes}


def aperture_rule(arrangement: Arrangement) -> tuple[Floats, Floats]:
    """Positions about a lenslet's centre, in pitches, (node, xy), and weights, (node,), of a mean over its aperture.

    Gauss-Legendre rules, exact up to degree 16 of a gradient's mode.
    """
    nodes, weights = np.polynomial.legendre.leggauss(_HIGHEST_DEGREE // 2 + 1)
    if arrangement == "square":
        x, y = (grid.ravel() / 2 for grid in np.meshgrid(nodes, nodes))
        return np.stack([x, y], axis=-1), np.outer(weights, weights).ravel() / 4
    along = (nodes + 1) / 4  # of the right half, in pitches
    edge = (1 - along) / math.sqrt(3)  # upper one
    x, height = np.concatenate([along, -along]), np.concatenate([edge, edge])
    position = np.stack([np.repeat(x, nodes.size), np.outer(height, nodes).ravel()], axis=-1)
    share = np.outer(np.tile(weights, 2) * height, weights).ravel()
    return position, share / share.sum()


def aperture_means(gradients: Callable[[Floats, Floats], Floats], sensor: Sensor, unit_m: Floats) -> Floats:
    """Means over the lenslets of gradients (mode, *shape, xy) at positions in `unit_m` (xy,)."""
    centers_m, total = sensor.lenslet_centers_m, 0.0
    for position, share in zip(*aperture_rule(sensor.arrangement), strict=True):
        at = (centers_m + position * sensor.lenslet_pitch_m) / unit_m
        total = total + share * gradients(at[..., 0], at[..., 1])
    return np.asarray(total)


class PupilGrid:
    """Evaluates wavefronts on a grid of pupil positions, prepared once."""

    def __init__(self, modes: PupilModes, sensor: Sensor, x_m: Floats, y_m: Floats) -> None:
        """Prepare for all combinations of the pupil positions x_m (x,) and y_m (y,)."""
        self._products = modes.products
        highest = modes.products.shape[1] - 1
        derive = series.legder(np.eye(highest + 1)) if highest else np.zeros((1, 1))
        (self._along_x, self._slope_x), (self._along_y, self._slope_y) = (
            (
                series.legvander(at_m / half_m, highest).astype(np.float32),
                (series.legvander(at_m / half_m, len(derive) - 1) @ derive / half_m).astype(np.float32),
            )
            for at_m, half_m in zip((x_m, y_m), sensor.pupil_half_width_m, strict=True)
        )

    def __call__(self, coefficients: Floats) -> Image:
        """Phase (y, x), rad, of a wavefront with the `coefficients` (pupil_mode,), rad."""
        return self._on(coefficients, self._along_y, self._along_x)

    def gradients(self, coefficients: Floats) -> tuple[Image, Image]:
        """Derivatives of the phase along x and along y, rad/m, each (y, x)."""
        along_x = self._on(coefficients, self._along_y, self._slope_x)
        return along_x, self._on(coefficients, self._slope_y, self._along_x)

    def _on(self, coefficients: Floats, of_y: Image, of_x: Image) -> Image:
        products = np.tensordot(coefficients, self._products, axes=1).astype(np.float32)
        return np.asarray(of_y @ (products @ of_x.T), np.float32)
