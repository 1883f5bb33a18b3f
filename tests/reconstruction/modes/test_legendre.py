"""Legendre polynomials against SciPy, closed forms and numerical integration."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import special
from support.optics import sensor_of

from reconstruction.modes.polynomials import legendre, legendre_gradients, legendre_orders
from reconstruction.modes.pupil_modes import pupil_modes


def test_order_matches_paper() -> None:
    for k, (m, n) in enumerate(legendre_orders(45)):
        assert k == (m + n) * (m + n + 1) // 2 + n
    assert legendre_orders(6) == ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))


def test_values_match_scipy() -> None:
    x, y = np.random.default_rng(1).uniform(-1, 1, (2, 50))
    values = legendre(66, x, y)
    for k, (m, n) in enumerate(legendre_orders(66)):
        np.testing.assert_allclose(values[k], special.eval_legendre(m, x) * special.eval_legendre(n, y), atol=1e-12)


def test_positions_are_broadcast() -> None:
    x, y = np.array([0.1, 0.5, -0.3]), np.array([[0.2], [-0.8]])
    grid = legendre(6, *np.meshgrid(x, y.ravel()))
    np.testing.assert_allclose(legendre(6, x, y), grid)
    assert legendre_gradients(6, x, y).shape == (6, 2, 3, 2)


def test_low_modes_match_closed_form() -> None:
    x, y = 0.3, -0.7
    expected = [1, x, y, (3 * x**2 - 1) / 2, x * y, (3 * y**2 - 1) / 2]
    np.testing.assert_allclose(legendre(6, x, y), expected, atol=1e-15)
    np.testing.assert_allclose(legendre_gradients(6, x, y)[4], [y, x], atol=1e-15)


def test_gradients_match_numerical_derivatives() -> None:
    x, y = np.random.default_rng(2).uniform(-0.9, 0.9, (2, 20))
    step = 1e-6
    gradients = legendre_gradients(45, x, y)
    along_x = (legendre(45, x + step, y) - legendre(45, x - step, y)) / (2 * step)
    along_y = (legendre(45, x, y + step) - legendre(45, x, y - step)) / (2 * step)
    np.testing.assert_allclose(gradients[..., 0], along_x, atol=1e-7)
    np.testing.assert_allclose(gradients[..., 1], along_y, atol=1e-7)


@pytest.mark.parametrize("k", [1, 4, 13, 40])
def test_lenslet_means_match_numerical_integrals(k: int) -> None:
    rows, columns = 3, 5
    sensor = sensor_of(rows, columns)
    means = pupil_modes(sensor, "legendre", k + 1).gradients[k] * sensor.pupil_half_width_m
    node, weight = np.polynomial.legendre.leggauss(16)  # exact for these polynomials
    for row, column in np.ndindex(rows, columns):
        x, y = -1 + (2 * column + 1 + node) / columns, -1 + (2 * row + 1 + node[:, None]) / rows
        gradients = legendre_gradients(k + 1, x, y)[k]
        expected = np.einsum("yxa,x,y->a", gradients, weight, weight) / 4
        assert means[row, column] == pytest.approx(expected, abs=1e-9)
