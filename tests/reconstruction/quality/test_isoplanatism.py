"""Isoplanatism of wavefronts that are polynomials of field and pupil."""

from __future__ import annotations

import numpy as np
import pytest
from support.optics import FIELD, converged, sensor_of

from reconstruction.arrays import Floats
from reconstruction.geometry import Field
from reconstruction.modes.field_modes import LegendreModes
from reconstruction.quality.isoplanatism import field_cell_middles_m, global_error_rad, isoplanatism, structure_curve
from reconstruction.wavefront import Wavefront, without_zernikes

ROWS, COLUMNS = 9, 13
U, V = np.meshgrid(np.arange(COLUMNS) - 6.0, np.arange(ROWS) - 4.0)  # in lenslets
RMS_U, RMS_V = np.sqrt((13**2 - 1) / 12), np.sqrt((9**2 - 1) / 12)  # of whole steps about zero


class Tilting:
    """A solution whose tilt along the pupil's x rises with the field's x, and along y with y."""

    def __init__(self, along_x: float, along_y: float) -> None:
        self.along_x, self.along_y = along_x, along_y

    def wavefront(self, field_modes: Floats) -> Floats:
        x, y = field_modes[..., 1, None, None], field_modes[..., 2, None, None]
        return np.asarray(self.along_x * x * U + self.along_y * y * V)

    def sigma(self, field_modes: Floats) -> Floats:
        return np.zeros((*field_modes.shape[:-1], ROWS, COLUMNS))


def wavefront(along_x: float, along_y: float, field: Field = FIELD) -> Wavefront:
    zeros = np.zeros((ROWS, COLUMNS, 3, 2))
    displacement = converged(LegendreModes(3), zeros, zeros)
    return Wavefront.of(sensor_of(ROWS, COLUMNS), field, displacement, Tilting(along_x, along_y))  # type: ignore[arg-type] # a stand-in


def test_linear_tilt_differs_in_proportion_to_separation() -> None:
    strength = 3.0  # rad RMS over the half width of the field, along x as along y
    found = isoplanatism(wavefront(strength / RMS_U, strength / RMS_V))
    expected_rad = strength * found.curve.separation_m / FIELD.half_width_m
    np.testing.assert_allclose(found.curve.rms_rad, expected_rad)
    assert np.all(found.curve.least_rad <= expected_rad)
    assert np.all(found.curve.most_rad >= expected_rad)
    assert np.all(np.diff(found.curve.separation_m) > 0)
    assert found.curve.patch_m == pytest.approx(FIELD.half_width_m / strength)
    np.testing.assert_allclose(found.curve_without_tilt.rms_rad, 0, atol=1e-9)
    assert found.curve_without_tilt.patch_m == np.inf
    steps = np.sqrt((7**2 - 1) / 12) * 2 / 7  # root mean square of the positions, in half widths
    assert found.error_rad == pytest.approx(strength * steps * np.sqrt(2))
    assert found.error_without_tilt_rad == pytest.approx(0, abs=1e-9)


def test_view_error_grows_with_distance_from_field_centre() -> None:
    found = isoplanatism(wavefront(0.2, 0))
    at = 0.2 * RMS_U * 5 / 6
    np.testing.assert_allclose(found.view_error_rad, np.tile([at, 0, at], (3, 1)), atol=1e-9)


def test_shifted_cubic_without_tilt_leaves_curvature() -> None:
    x_m = np.linspace(0, 1e-3, 5)
    position_m = np.stack([x_m, np.zeros(5)], axis=-1)
    shift = 400.0 * x_m[:, None, None]  # lenslets
    strength = 0.05
    phase = strength * (U - shift) ** 3  # differs by 3 strength shift u^2, by tilt, and by piston
    curve = structure_curve(without_zernikes(phase, (2, 3), sensor_of(ROWS, COLUMNS)), position_m, bin_m=0.25e-3)
    np.testing.assert_allclose(curve.separation_m, x_m[1:])
    rms_u2 = np.sqrt((13**2 - 1) * (13**2 - 4) / 180)  # of the squares of 13 whole steps, about their mean
    np.testing.assert_allclose(curve.rms_rad, 3 * strength * 400 * x_m[1:] * rms_u2)
    np.testing.assert_allclose(curve.least_rad, curve.most_rad)


def test_patch_is_interpolated_infinite_or_nan() -> None:
    position_m = np.array([[0, 0], [1, 0], [3, 0]]) * 1e-3
    phase = np.array([0.0, 0.5, 2.5])[:, None, None] * U / RMS_U
    curve = structure_curve(phase, position_m, bin_m=1e-3)
    np.testing.assert_allclose(curve.rms_rad, [0.5, 2.0, 2.5])
    assert curve.patch_m == pytest.approx(1e-3 + 1e-3 * 0.5 / 1.5)
    nothing = structure_curve(phase * np.nan, position_m, bin_m=1e-3)
    np.testing.assert_array_equal(nothing.separation_m, curve.separation_m)
    assert np.isnan([*nothing.rms_rad, *nothing.least_rad, *nothing.most_rad, nothing.patch_m]).all()
    phase[2] = np.nan  # the pairs with the farthest position
    partly = structure_curve(phase, position_m, bin_m=1e-3)
    np.testing.assert_allclose(partly.rms_rad, [0.5, np.nan, np.nan])
    assert partly.patch_m == np.inf


def test_global_error_is_rms_of_difference_from_mean() -> None:
    common = np.random.default_rng(2).normal(0, 5, (ROWS, COLUMNS))
    phase = common + np.array([-1.0, 1.0])[:, None, None] * U / RMS_U
    assert global_error_rad(phase) == pytest.approx(1.0)
    phase[0, 2, 3] = np.nan
    assert global_error_rad(phase) == pytest.approx(1.0, rel=0.02)


def test_without_tilt_ignores_unknown_lenslets() -> None:
    phase = np.stack([3 + 2 * U - V, U * V])
    phase[0, 0, 0] = phase[0, 5] = np.nan
    flat = without_zernikes(phase, (2, 3), sensor_of(ROWS, COLUMNS))
    np.testing.assert_allclose(flat[0][np.isfinite(phase[0])], 0, atol=1e-12)
    np.testing.assert_array_equal(np.isnan(flat), np.isnan(phase))
    np.testing.assert_allclose(flat[1], U * V, atol=1e-12)


def test_field_positions_are_middles_of_equal_parts() -> None:
    square_m = field_cell_middles_m(FIELD, 3)
    np.testing.assert_allclose(square_m[:4], np.array([[-0.4, -0.4], [0, -0.4], [0.4, -0.4], [-0.4, 0]]) * 1e-3)
    assert len(square_m) == 9
    circle = Field(collimator_focal_length_m=0.2, half_width_m=0.6e-3, shape="circle", view_rows=1, view_columns=1)
    in_circle_m = field_cell_middles_m(circle, 7)
    assert np.hypot(*in_circle_m.T).max() <= 0.6e-3
    assert len(in_circle_m) == 37  # 49 without three at each corner


def test_circular_field_compares_only_positions_inside() -> None:
    circle = Field(collimator_focal_length_m=0.2, half_width_m=0.6e-3, shape="circle", view_spacing_m=0.5e-3)
    found = isoplanatism(wavefront(0.2, 0.2, circle))
    assert found.curve.separation_m.max() < 1.2e-3
    assert np.isnan(found.view_error_rad[0, 0])
    assert np.isfinite(found.view_error_rad[1, 1])
