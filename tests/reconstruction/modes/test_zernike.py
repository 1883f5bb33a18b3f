"""Zernike polynomials against Noll's closed forms, their orthonormality, and numerical derivatives."""

from __future__ import annotations

import numpy as np
import pytest
from support.optics import sensor_of

from reconstruction.modes.polynomials import (
    ZernikeOrder,
    noll_orders,
    zernike,
    zernike_amplitudes,
    zernike_gradients,
    zernike_names,
    zernike_numbers,
)
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


Z80_28 = {  # ANSI Z80.28-2017, table B.1: index to (n, m)
    0: (0, 0),
    1: (1, -1),
    2: (1, 1),
    3: (2, -2),
    4: (2, 0),
    5: (2, 2),
    6: (3, -3),
    7: (3, -1),
    8: (3, 1),
    9: (3, 3),
    10: (4, -4),
    11: (4, -2),
    12: (4, 0),
    13: (4, 2),
    14: (4, 4),
    15: (5, -5),
    16: (5, -3),
    17: (5, -1),
    18: (5, 1),
    19: (5, 3),
    20: (5, 5),
    21: (6, -6),
    22: (6, -4),
    23: (6, -2),
    24: (6, 0),
    25: (6, 2),
    26: (6, 4),
    27: (6, 6),
}
FRINGE = {  # J. C. Wyant and K. Creath, Applied Optics and Optical Engineering XI, table III; counted from 1
    1: (0, 0),
    2: (1, 1),
    3: (1, -1),
    4: (2, 0),
    5: (2, 2),
    6: (2, -2),
    7: (3, 1),
    8: (3, -1),
    9: (4, 0),
    10: (3, 3),
    11: (3, -3),
    12: (4, 2),
    13: (4, -2),
    14: (5, 1),
    15: (5, -1),
    16: (6, 0),
    17: (4, 4),
    18: (4, -4),
    19: (5, 3),
    20: (5, -3),
    21: (6, 2),
    22: (6, -2),
    23: (7, 1),
    24: (7, -1),
    25: (8, 0),
    26: (5, 5),
    27: (5, -5),
    28: (6, 4),
    29: (6, -4),
    30: (7, 3),
    31: (7, -3),
    32: (8, 2),
    33: (8, -2),
    34: (9, 1),
    35: (9, -1),
    36: (10, 0),
}
NOLL_ORDERS = {  # Noll 1976, table I, a cosine (m > 0) where the number is even
    1: (0, 0),
    2: (1, 1),
    3: (1, -1),
    4: (2, 0),
    5: (2, -2),
    6: (2, 2),
    7: (3, -1),
    8: (3, 1),
    9: (3, -3),
    10: (3, 3),
    11: (4, 0),
    12: (4, 2),
    13: (4, -2),
    14: (4, 4),
    15: (4, -4),
    16: (5, 1),
    17: (5, -1),
    18: (5, 3),
    19: (5, -3),
    20: (5, 5),
    21: (5, -5),
    22: (6, 0),
}


@pytest.mark.parametrize(("order", "table"), [("noll", NOLL_ORDERS), ("osa", Z80_28), ("fringe", FRINGE)])
def test_numbers_are_those_of_published_table(order: ZernikeOrder, table: dict[int, tuple[int, int]]) -> None:
    found = dict(zip(zernike_numbers(66, order), noll_orders(66), strict=True))
    assert {number: found[number] for number in table} == table
    assert len(found) == 66


def test_names_carry_number_of_order() -> None:
    of_spherical = [zernike_names(15, order)[10] for order in ("noll", "osa", "fringe")]
    assert of_spherical == [f"Z{number} spherical aberration" for number in (11, 12, 9)]


def test_fringe_modes_are_one_at_edge() -> None:
    angle = np.linspace(0, 2 * np.pi, 361)
    modes = zernike(45, np.cos(angle), np.sin(angle)) / zernike_amplitudes(45)[:, None]
    np.testing.assert_allclose(modes.max(axis=1), 1, atol=1e-3)  # cosines between the samples
    np.testing.assert_allclose(modes[21], 1, rtol=1e-12)  # 20 r^6 - 30 r^4 + 12 r^2 - 1


def mahajan(r: np.ndarray, e: float) -> dict[tuple[int, int], np.ndarray]:
    """Annular radial polynomials, with RMS 1 / sqrt(n + 1): V. N. Mahajan, J. Opt. Soc. Am. 71, 75 (1981), table 1."""
    s = [sum(e ** (2 * k) for k in range(count)) for count in range(6)]  # 1 + e^2 + ...
    last = 16 * (1 - e**10) - 15 * (1 - e**8) ** 2 / (1 - e**6)
    return {
        (1, 1): r / np.sqrt(s[2]),
        (2, 0): (2 * r**2 - 1 - e**2) / (1 - e**2),
        (2, 2): r**2 / np.sqrt(s[3]),
        (3, 1): (3 * s[2] * r**3 - 2 * s[3] * r) / (1 - e**2) / np.sqrt(s[2] * (1 + 4 * e**2 + e**4)),
        (3, 3): r**3 / np.sqrt(s[4]),
        (4, 0): (6 * r**4 - 6 * s[2] * r**2 + 1 + 4 * e**2 + e**4) / (1 - e**2) ** 2,
        (4, 2): (4 * r**4 - 3 * (1 - e**8) / (1 - e**6) * r**2) / np.sqrt(last / (1 - e**2)),
        (4, 4): r**4 / np.sqrt(s[5]),
    }


@pytest.mark.parametrize("obscuration", [1e-3, 0.2, 0.5, 0.9])
def test_annular_modes_match_mahajans_table(obscuration: float) -> None:
    found = zernike(15, X, Y, obscuration)
    for (n, m), radial in mahajan(R, obscuration).items():
        factor = np.sqrt((n + 1) * (1 if m == 0 else 2))
        for sign, angular in ((1, np.cos(m * THETA)), (-1, np.sin(m * THETA)))[: 1 if m == 0 else 2]:
            mode = found[noll_orders(15).index((n, sign * m))]
            np.testing.assert_allclose(mode, factor * radial * angular, rtol=0, atol=1e-12 * np.abs(mode).max())


def test_complete_radial_orders_have_1_3_6_10_modes() -> None:
    orders = noll_orders(10)
    assert [sum(n <= degree for n, _ in orders) for degree in range(4)] == [1, 3, 6, 10]


@pytest.mark.parametrize("obscuration", [0.0, 1e-3, 0.2, 0.5, 0.9])
def test_modes_are_orthonormal_over_pupil(obscuration: float) -> None:
    nodes, weights = np.polynomial.legendre.leggauss(40)
    r, weight_r = (1 + obscuration + (1 - obscuration) * nodes) / 2, weights / (1 + obscuration)
    theta = np.arange(64) * 2 * np.pi / 64
    modes = zernike(153, r[:, None] * np.cos(theta), r[:, None] * np.sin(theta), obscuration)
    products = np.einsum("jrt,krt,r->jk", modes, modes, weight_r * r) / 64
    np.testing.assert_allclose(products, np.eye(153), rtol=0, atol=1e-12)


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
