"""Zernike polynomials against Noll's closed forms, their orthonormality, and numerical derivatives."""

from __future__ import annotations

import numpy as np
import pytest
from support.optics import sensor_of

from reconstruction.modes.polynomials import noll_orders, zernike, zernike_gradients
from reconstruction.modes.pupil_modes import pupil_modes

X, Y = np.random.default_rng(0).uniform(-0.7, 0.7, (2, 40))
R, THETA = np.hypot(X, Y), np.arctan2(Y, X)

NOLL = {  # Noll 1976, table I
    1: np.ones_like(R),
    2: 2 * R * np.cos(THETA),
    3: 2 * R * np.sin(THETA),
    4: np.sqrt(3) * (2 * R**2 - 1),
    5: np.sqrt(6) * R**2 * np.sin(2 * THETA),
    6: np.sqrt(6) * R**2 * np.cos(2 * THETA),
    7: np.sqrt(8) * (3 * R**3 - 2 * R) * np.sin(THETA),
    8: np.sqrt(8) * (3 * R**3 - 2 * R) * np.cos(THETA),
    9: np.sqrt(8) * R**3 * np.sin(3 * THETA),
    10: np.sqrt(8) * R**3 * np.cos(3 * THETA),
    11: np.sqrt(5) * (6 * R**4 - 6 * R**2 + 1),
    12: np.sqrt(10) * (4 * R**4 - 3 * R**2) * np.cos(2 * THETA),
    13: np.sqrt(10) * (4 * R**4 - 3 * R**2) * np.sin(2 * THETA),
    14: np.sqrt(10) * R**4 * np.cos(4 * THETA),
    15: np.sqrt(10) * R**4 * np.sin(4 * THETA),
}


@pytest.mark.parametrize("j", NOLL)
def test_modes_match_nolls_table(j: int) -> None:
    np.testing.assert_allclose(zernike(15, X, Y)[j - 1], NOLL[j], atol=1e-12)


def test_complete_radial_orders_have_1_3_6_10_modes() -> None:
    orders = noll_orders(10)
    assert [sum(n <= degree for n, _ in orders) for degree in range(4)] == [1, 3, 6, 10]


def test_modes_are_orthonormal_over_circle() -> None:
    nodes, weights = np.polynomial.legendre.leggauss(20)
    r, weight_r = (nodes + 1) / 2, weights / 2
    theta = np.arange(64) * 2 * np.pi / 64
    modes = zernike(45, r[:, None] * np.cos(theta), r[:, None] * np.sin(theta))
    products = np.einsum("jrt,krt,r->jk", modes, modes, weight_r * r) * 2 / 64
    np.testing.assert_allclose(products, np.eye(45), atol=1e-10)


def test_gradients_match_numerical_derivatives() -> None:
    step = 1e-6
    gradients = zernike_gradients(36, X, Y)
    along_x = (zernike(36, X + step, Y) - zernike(36, X - step, Y)) / (2 * step)
    along_y = (zernike(36, X, Y + step) - zernike(36, X, Y - step)) / (2 * step)
    np.testing.assert_allclose(gradients[..., 0], along_x, atol=1e-6)
    np.testing.assert_allclose(gradients[..., 1], along_y, atol=1e-6)


def test_gradients_are_finite_at_centre() -> None:
    assert np.isfinite(zernike_gradients(36, 0.0, 0.0)).all()


@pytest.mark.parametrize("k", [3, 7, 20])
def test_lenslet_means_match_numerical_integrals(k: int) -> None:
    sensor = sensor_of(3, 4)
    radius_m = min(sensor.pupil_half_width_m)
    means = pupil_modes(sensor, "zernike", k + 1).gradients[k]
    node, weight = np.polynomial.legendre.leggauss(16)  # exact for these polynomials
    for row, column in ((0, 0), (1, 3), (2, 1)):
        center_m, half_m = sensor.lenslet_centers_m[row, column], sensor.lenslet_pitch_m / 2
        x, y = ((middle_m + half_m * node) / radius_m for middle_m in center_m)
        gradients = zernike_gradients(k + 1, x, y[:, None])[k] / radius_m
        expected = np.einsum("yxa,x,y->a", gradients, weight, weight) / 4
        assert means[row, column] == pytest.approx(expected, rel=1e-9, abs=1e-6)
