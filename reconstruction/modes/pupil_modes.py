"""Pupil modes R_p, in which a wavefront is written: phi(u) = sum_p e_p R_p(u)."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre as series
from numpy.typing import NDArray

from reconstruction.arrays import Booleans, Floats, Image
from reconstruction.errors import ReconstructionError
from reconstruction.geometry import Arrangement, Sensor
from reconstruction.modes.polynomials import (
    ORDERS,
    legendre_names,
    legendre_products,
    legendre_projection,
    legendre_slopes,
    number_up_to,
    zernike_names,
    zernike_products,
)
from reconstruction.settings import PupilBasis

_HIGHEST_DEGREE = 16  # highest for which the mean gradients of both bases are exact
ROUNDING_SHARE = 1e-12  # of a polynomial's largest coefficient; one that is not larger is rounding


@dataclass(frozen=True, slots=True, eq=False)
class PupilModes:
    """The modes R_p on the lenslets of a sensor, piston first."""

    values: Floats  # at the lenslet centres, (pupil_mode, lenslet_row, lenslet_column)
    gradients: Floats  # mean over each lenslet, 1/m, (pupil_mode, lenslet_row, lenslet_column, xy)
    inside: Booleans  # lenslets inside the pupil, (lenslet_row, lenslet_column)
    degree: Floats  # of the polynomial, (pupil_mode,)
    products: Floats  # R_p as a sum of products P_m(xi) P_n(eta): (pupil_mode, n, m), xi, eta over the whole lattice


@dataclass(frozen=True, slots=True)
class Basis:
    """A basis of pupil modes."""

    title: str
    modes: Callable[[Sensor, int], PupilModes]  # the first ones, by degree, d + 1 of each degree d
    names: Callable[[int], tuple[str, ...]]  # of the first ones
    about: str  # order, normalisation and domain


def pupil_modes(sensor: Sensor, basis: PupilBasis, count: int | None) -> PupilModes:
    """Modes of one of the `BASES`, piston first; `ReconstructionError` if there is no such basis.

    Without a `count`, all modes of a degree below the number of lenslets a side, and at most 16.
    """
    if basis not in BASES:
        raise ReconstructionError(f"there is no basis {basis}: it must be {' or '.join(BASES)}")
    if count is None:
        count = number_up_to(min(min(sensor.lenslets) - 1, _HIGHEST_DEGREE))
    return BASES[basis].modes(sensor, count)


def _zernike_modes(sensor: Sensor, count: int) -> PupilModes:
    """Zernike modes over the circle or annulus of the pupil; a lenslet is inside if its centre is."""
    circle = sensor.circle
    half_x, half_y = circle.normalised(np.array(sensor.pupil_half_width_m))
    center = circle.normalised(np.zeros(2))
    products = zernike_products(
        count, half_x - center[0], half_y - center[1], center=(-center[0], -center[1]), obscuration=circle.obscuration
    )
    return polynomial_modes(sensor, products, circle.contains(sensor.lenslet_centers_m))


BASES: dict[PupilBasis, Basis] = {
    "legendre": Basis(
        "Legendre",
        lambda sensor, count: polynomial_modes(sensor, legendre_products(count)),
        legendre_names,
        "products of Legendre polynomials over the lattice, by degree, from 0",
    ),
    "zernike": Basis(
        "Zernike (Noll)", _zernike_modes, zernike_names, f"{ORDERS['noll']}, over the circle or annulus of the pupil"
    ),
}


def aperture_rule(arrangement: Arrangement) -> tuple[Floats, Floats]:
    """Gauss-Legendre positions, pitches, (node, xy), weights (node,), of an aperture mean, exact to degree 16."""
    nodes, weights = series.leggauss(_HIGHEST_DEGREE // 2 + 1)
    if arrangement == "square":
        x, y = (grid.ravel() / 2 for grid in np.meshgrid(nodes, nodes))
        return np.stack([x, y], axis=-1), np.outer(weights, weights).ravel() / 4
    along = (nodes + 1) / 4  # of the right half, in pitches
    edge = (1 - along) / math.sqrt(3)  # upper one
    x, height = np.concatenate([along, -along]), np.concatenate([edge, edge])
    position = np.stack([np.repeat(x, nodes.size), np.outer(height, nodes).ravel()], axis=-1)
    share = np.outer(np.tile(weights, 2) * height, weights).ravel()
    return position, share / share.sum()


def polynomial_modes(sensor: Sensor, products: Floats, inside: Booleans | None = None) -> PupilModes:
    """Make pupil modes of any polynomials; their gradients are means over the lenslets.

    Parameters
    ----------
    sensor : Sensor
        Its pupil is that of the modes.
    products : (pupil_mode, n, m)
        The modes as sums of products P_n(eta) P_m(xi) of Legendre polynomials, xi (along x) and eta (along y) from -1
        to 1 over the whole lattice; the first is the piston.
    inside : bool (lenslet_row, lenslet_column), optional
        Lenslets over which the modes count; by default those inside the sensor's pupil.

    Raises
    ------
    ValueError
        If the first mode is not the piston.
    """
    is_part = np.abs(products) > ROUNDING_SHARE * np.abs(products).max(axis=(1, 2), keepdims=True)
    if np.flatnonzero(is_part[0]).tolist() != [0]:
        raise ValueError("the first pupil mode must be the piston, a constant")
    highest = products.shape[1] - 1
    if sensor.arrangement == "square":
        (mean_x, slope_x), (mean_y, slope_y) = (
            _cell_means(centers_m / half_m, sensor.lenslet_pitch_m / 2 / half_m, half_m, highest)
            for centers_m, half_m in zip((sensor.pupil_x_m, sensor.pupil_y_m), sensor.pupil_half_width_m, strict=True)
        )
        gradients = np.stack([_on_grid(products, mean_y, slope_x), _on_grid(products, slope_y, mean_x)], axis=-1)
    else:
        means = sum(
            share * np.stack(_products_at(sensor, position, highest)[1:])
            for position, share in zip(*aperture_rule(sensor.arrangement), strict=True)
        )
        gradients = np.moveaxis(np.tensordot(products, means, axes=((1, 2), (3, 4))), 1, -1)
    values = np.tensordot(products, _products_at(sensor, np.zeros(2), highest)[0], axes=((1, 2), (2, 3)))
    n, m = np.indices(products.shape[1:])
    return PupilModes(
        values=values,
        gradients=gradients,
        inside=sensor.is_in_pupil if inside is None else inside,
        degree=np.max((n + m) * is_part, axis=(1, 2)).astype(np.float64),
        products=products,
    )


def _cell_means(centers: Floats, half_cell: float, half_m: float, degree: int) -> tuple[Floats, Floats]:
    """Means over cells of P_0 ... P_degree and their derivatives, 1/m: (cell, degree + 1) each."""
    nodes, weights = series.leggauss(degree // 2 + 1)
    at = centers[:, None] + half_cell * nodes
    mean, slope = (
        np.tensordot(of, weights / 2, axes=(1, 0))
        for of in (series.legvander(at, degree), legendre_slopes(at, degree) / half_m)
    )
    return mean, slope


def _products_at(sensor: Sensor, position: Floats, degree: int) -> tuple[Floats, Floats, Floats]:
    """P_n P_m and derivatives along x and y, 1/m, at a position (xy,), pitches, in each lenslet."""
    half_m = np.array(sensor.pupil_half_width_m)
    at = (sensor.lenslet_centers_m + position * sensor.lenslet_pitch_m) / half_m
    (of_x, of_y), (slope_x, slope_y) = (
        np.moveaxis(each, 2, 0)
        for each in (series.legvander(at, degree), legendre_slopes(at, degree) / half_m[:, None])
    )
    pairs = ((of_y, of_x), (of_y, slope_x), (slope_y, of_x))
    center, along_x, along_y = (one[..., :, None] * other[..., None, :] for one, other in pairs)
    return center, along_x, along_y


def _on_grid(products: Floats, of_y: Floats, of_x: Floats) -> Floats:
    """Sums of P_n P_m, (mode, n, m), for factors by row (row, n) and column (column, m)."""
    return np.asarray(of_y @ (products @ of_x.T))


class PupilGrid:
    """Evaluates wavefronts on a grid of pupil positions, prepared once."""

    def __init__(self, modes: PupilModes, sensor: Sensor, x_m: Floats, y_m: Floats) -> None:
        """Prepare for all combinations of the pupil positions x_m (x,) and y_m (y,)."""
        self._products, highest = modes.products, modes.products.shape[1] - 1
        (self._along_x, self._slope_x), (self._along_y, self._slope_y) = (
            [
                (evaluate(at_m / half_m, highest) / unit).astype(np.float32)
                for evaluate, unit in ((series.legvander, 1.0), (legendre_slopes, half_m))
            ]
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


def local_wavefronts(products: Floats, sensor: Sensor, degree: int, rows: NDArray[np.intp] | None = None) -> Floats:
    """Project pupil modes on products P_m(xi) P_n(eta) over each lenslet, m, n <= `degree`.

    xi and eta are -1 ... 1 over the square around the aperture of a lenslet. From `products` (pupil_mode, n, m), see
    `PupilModes`, to the coefficients (lenslet_row, lenslet_column, n, m, pupil_mode) in some `rows` of lenslets, or in
    all.
    """
    highest = products.shape[1] - 1
    nodes, project = legendre_projection(degree, highest)  # (node, local)

    def in_cells(center_m: Floats, half_width_m: float) -> Floats:
        at = (center_m[:, None] + nodes * sensor.aperture_width_m / 2) / half_width_m
        return np.asarray(np.einsum("cik,ij->cjk", series.legvander(at, highest), project))  # (cell, local, k)

    half_x_m, half_y_m = sensor.pupil_half_width_m
    rows = np.arange(sensor.lenslets[0]) if rows is None else rows
    along_y = in_cells(sensor.pupil_y_m[rows], half_y_m)
    rows_of_x = sensor.lenslet_centers_m[:2, :, 0]  # of even and of odd rows
    local = np.empty((len(along_y), rows_of_x.shape[1], degree + 1, degree + 1, len(products)))
    for first, x_m in enumerate(rows_of_x):
        along_x, some = in_cells(x_m, half_x_m), rows % 2 == first
        local[some] = np.einsum("pkl,rnk,cml->rcnmp", products, along_y[some], along_x, optimize=True)
    return local
