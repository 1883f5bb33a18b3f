"""Pupil modes between the lenslets, against the polynomials themselves."""

from __future__ import annotations

import numpy as np
import pytest
from support.optics import sensor_of

from reconstruction.modes.polynomials import legendre, zernike
from reconstruction.modes.pupil_modes import PupilGrid, pupil_modes

SENSOR = sensor_of(6, 9)
X_M, Y_M = np.linspace(-2.2e-3, 2.0e-3, 7), np.linspace(-1.4e-3, 1.5e-3, 5)


@pytest.mark.parametrize("basis", ["legendre", "zernike"])
def test_pupil_grid_matches_polynomials_between_lenslets(basis: str) -> None:
    modes = pupil_modes(SENSOR, basis, 21)  # type: ignore[arg-type] # parametrised
    coefficients = np.random.default_rng(0).normal(size=21)
    if basis == "legendre":
        values = legendre(21, X_M / 2.25e-3, Y_M[:, None] / 1.5e-3)
    else:
        values = zernike(21, X_M / 1.5e-3, Y_M[:, None] / 1.5e-3)
    found = PupilGrid(modes, SENSOR, X_M, Y_M)(coefficients)
    np.testing.assert_allclose(found, np.tensordot(coefficients, values, axes=1), rtol=2e-4, atol=2e-4)


@pytest.mark.parametrize(("rows", "columns", "count"), [(15, 15, 120), (6, 9, 21), (2, 5, 3), (64, 64, 153)])
def test_default_mode_count_follows_lattice_size(rows: int, columns: int, count: int) -> None:
    assert len(pupil_modes(sensor_of(rows, columns), "legendre", None).values) == count
