"""Image quality on hexagonal lattices: closed forms, and the same wavefront on a fine square lattice."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.optics import sensor_of

from reconstruction.arrays import Floats
from reconstruction.geometry import Lattice
from reconstruction.quality.image_quality import aligned, mtf, psf, psf_reach_rad
from reconstruction.quality.reference_quality import lattice_error_px
from reconstruction.wavefront import without_zernikes

SENSOR = replace(sensor_of(8, 7), arrangement="hexagonal")
X_M, Y_M = np.moveaxis(SENSOR.lenslet_centers_m, -1, 0)


def test_aligned_rows_hold_a_cubic_wavefront_at_straight_columns() -> None:
    def cubic(x: Floats) -> Floats:
        return np.asarray(1.0 + 2e2 * x - 3e5 * x**2 + 4e8 * x**3 + 5e2 * Y_M)

    phase = cubic(X_M)
    phase[2, 3] = np.nan
    expected = np.where(np.isnan(phase), np.nan, cubic(np.linspace(-1.5e-3, 1.5e-3, 7)))
    np.testing.assert_allclose(aligned(phase, "hexagonal"), expected, atol=1e-9)


def test_unknown_view_does_not_spoil_others() -> None:
    views = np.stack([3e2 * X_M, np.full(X_M.shape, np.nan)])
    assert np.isnan(aligned(views, "hexagonal")[1]).all()
    np.testing.assert_allclose(
        aligned(views, "hexagonal")[0], np.tile(3e2 * (np.arange(7) - 3) * 0.5e-3, (8, 1)), atol=1e-12
    )


def test_tilt_moves_the_peak_by_its_slope() -> None:
    slope = np.array([2.0e3, -1.2e3])  # rad/m
    angle_rad = np.linspace(-4, 4, 321) * 1e-4
    found = psf(X_M * slope[0] + Y_M * slope[1], SENSOR, angle_rad=angle_rad)
    row, column = np.unravel_index(np.argmax(found), found.shape)
    expected = slope / SENSOR.wavenumber_rad_per_m
    np.testing.assert_allclose([angle_rad[column], angle_rad[row]], expected, atol=2.6e-6)
    assert found.max() == pytest.approx(1, abs=2e-3)
    assert psf_reach_rad(X_M * 2.0e3, SENSOR) - psf_reach_rad(X_M * 0, SENSOR) == pytest.approx(expected[0], rel=1e-6)


def test_strehl_is_that_of_the_same_defocus_on_a_fine_square_lattice() -> None:
    fine = replace(sensor_of(96, 84), lenslet_pitch_m=500e-6 / 12, pixel_pitch_m=1e-6)
    width_m, height_m = 7 * 0.5e-3, 8 * 0.5e-3 * 3**0.5 / 2
    x_m, y_m = (np.arange(84) - 41.5) / 84 * width_m, (np.arange(96) - 47.5) / 96 * height_m
    strength = 5e5
    phase = strength * (x_m**2 + y_m[:, None] ** 2)
    expected = psf(phase, fine, angle_rad=np.zeros(1))[0, 0]
    found = psf(strength * (X_M**2 + Y_M**2), SENSOR, angle_rad=np.zeros(1))[0, 0]
    assert 0.1 < expected < 0.9
    assert found == pytest.approx(expected, rel=5e-3)


def test_modulation_ends_at_the_width_of_the_pupil() -> None:
    found = mtf(np.zeros(X_M.shape), SENSOR)
    assert found.frequency_x_per_rad[-1] == pytest.approx(7 * 0.5e-3 / 462e-9)
    assert found.frequency_y_per_rad[-1] == pytest.approx(8 * 0.5e-3 * 3**0.5 / 2 / 462e-9)
    np.testing.assert_allclose(found.along_y, 1 - found.frequency_y_per_rad / found.frequency_y_per_rad[-1], atol=1e-6)


def test_low_orders_are_polynomials_of_the_true_positions() -> None:
    phase = 3e2 * X_M - 2e2 * Y_M + 4e5 * (X_M**2 + Y_M**2)
    left = without_zernikes(phase, (2, 3, 4), SENSOR)
    np.testing.assert_allclose(left, 0, atol=1e-9)


@pytest.mark.parametrize(("rows", "columns"), [(0, 2), (1, 0), (1, -2), (-3, 1), (2, 0)])
def test_whole_steps_of_the_lattice_do_not_count_as_its_error(rows: int, columns: int) -> None:
    lattice = Lattice(center_x_px=100.0, center_y_px=90.0, pitch_px=30.0, arrangement="hexagonal")
    step = 30 * np.array([columns + rows % 2 / 2, rows * 3**0.5 / 2])
    moved = replace(lattice, center_x_px=100 + step[0] + 0.3, center_y_px=90 + step[1] - 0.4)
    assert lattice_error_px(lattice, moved, SENSOR) == pytest.approx(0.5)
    between = replace(lattice, center_x_px=115.0)
    assert lattice_error_px(lattice, between, SENSOR) == pytest.approx(15)
