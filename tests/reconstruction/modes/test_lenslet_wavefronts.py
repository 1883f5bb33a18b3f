"""Local wavefronts of pupil modes against the modes between the lenslets."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.optics import sensor_of

from reconstruction.geometry import Arrangement
from reconstruction.modes.polynomials import legendre, legendre_products, zernike, zernike_products
from reconstruction.modes.pupil_modes import local_wavefronts, pupil_modes
from reconstruction.settings import PupilBasis

X, Y = np.random.default_rng(0).uniform(-1, 1, (2, 50))


def test_products_of_legendre_polynomials_match_their_values() -> None:
    found = np.polynomial.legendre.legval2d(Y, X, np.moveaxis(legendre_products(45), 0, -1))  # n along y, m along x
    np.testing.assert_allclose(found, legendre(45, X, Y), atol=1e-12)


def test_products_of_zernike_polynomials_match_their_values() -> None:
    found = np.polynomial.legendre.legval2d(Y, X, np.moveaxis(zernike_products(45, 1.5, 0.7), 0, -1))
    np.testing.assert_allclose(found, zernike(45, 1.5 * X, 0.7 * Y), atol=1e-9)


@pytest.mark.parametrize("arrangement", ["square", "hexagonal"])
@pytest.mark.parametrize("basis", ["legendre", "zernike"])
def test_local_wavefronts_add_up_to_the_modes(basis: PupilBasis, arrangement: Arrangement) -> None:
    rows, columns = 5, 8
    sensor = replace(sensor_of(rows, columns), arrangement=arrangement)
    half_width_m = 0.25e-3 if arrangement == "square" else 0.5e-3 / 3**0.5
    modes = pupil_modes(sensor, basis, 28)  # of degree 6 at most: a local degree of 6 is exact
    local = local_wavefronts(modes.products, sensor, 6)
    half_x, half_y = sensor.pupil_half_width_m
    for row, column in np.ndindex(rows, columns):
        x_m, y_m = sensor.lenslet_centers_m[row, column]
        u_m, v_m = x_m + half_width_m * X, y_m + half_width_m * Y
        if basis == "legendre":
            expected = legendre(28, u_m / half_x, v_m / half_y)
        else:
            expected = zernike(28, u_m / min(half_x, half_y), v_m / min(half_x, half_y))
        found = np.polynomial.legendre.legval2d(Y, X, local[row, column])
        np.testing.assert_allclose(found, expected, atol=1e-10 * np.abs(expected).max())


def test_lower_degree_is_least_squares_projection() -> None:
    rows, columns = 3, 4
    sensor = sensor_of(rows, columns)
    modes = pupil_modes(sensor, "legendre", 28)
    local = local_wavefronts(modes.products, sensor, 2)
    assert local.shape == (rows, columns, 3, 3, 28)
    steps = (np.arange(400) + 0.5) / 200 - 1
    row, column = 0, 3
    values = legendre(28, (2 * column + 1 + steps - columns) / columns, (2 * row + 1 + steps[:, None] - rows) / rows)
    along = np.polynomial.legendre.legvander(steps, 2)
    fit = np.linalg.pinv(along)
    expected = np.einsum("pyx,ny,mx->nmp", values, fit, fit)
    np.testing.assert_allclose(local[row, column], expected, atol=2e-4)


def test_mean_gradient_is_that_of_the_pupil_modes() -> None:
    """Over a lenslet, the mean slope along x is that of P_1 and P_3 alone: from edge to edge."""
    sensor = sensor_of(4, 7)
    modes = pupil_modes(sensor, "legendre", 15)
    local = local_wavefronts(modes.products, sensor, 4)
    along_x = (local[:, :, 0, 1] + local[:, :, 0, 3]) * 2 / sensor.lenslet_pitch_m
    along_y = (local[:, :, 1, 0] + local[:, :, 3, 0]) * 2 / sensor.lenslet_pitch_m
    found = np.moveaxis(np.stack([along_x, along_y], axis=-1), 2, 0)
    np.testing.assert_allclose(found, modes.gradients, atol=1e-8)


@pytest.mark.parametrize("arrangement", ["square", "hexagonal"])
def test_some_rows_are_those_of_the_whole_lattice(arrangement: Arrangement) -> None:
    sensor = replace(sensor_of(5, 4), arrangement=arrangement)
    products = pupil_modes(sensor, "legendre", 15).products
    whole = local_wavefronts(products, sensor, 3)
    for rows in ([1], [0, 2], [1, 2, 4]):
        some = local_wavefronts(products, sensor, 3, np.array(rows))
        np.testing.assert_allclose(some, whole[rows], rtol=1e-13, atol=1e-13 * np.abs(whole).max())
