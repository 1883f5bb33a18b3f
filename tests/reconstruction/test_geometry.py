"""Geometry of sensor, lattice and field in closed form."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
import pytest
from support.optics import sensor_of

from reconstruction.geometry import Field, Lattice


def test_lenslet_centres_are_row_by_row_along_y() -> None:
    centers = Lattice(center_x_px=100.0, center_y_px=50.0, pitch_px=30.0).lenslet_centers_px(2, 3)
    assert centers.shape == (2, 3, 2)
    np.testing.assert_allclose(centers[0, 0], [70, 35])
    np.testing.assert_allclose(centers[0, 2], [130, 35])
    np.testing.assert_allclose(centers[1, 0], [70, 65])


def test_positive_rotation_turns_x_towards_y() -> None:
    lattice = Lattice(center_x_px=0.0, center_y_px=0.0, pitch_px=10.0, rotation_rad=0.1)
    np.testing.assert_allclose(lattice.to_camera_px(np.array([1.0, 0.0])), [math.cos(0.1), math.sin(0.1)])


def test_camera_transforms_are_inverse() -> None:
    lattice = Lattice(center_x_px=12.0, center_y_px=-3.0, pitch_px=10.0, rotation_rad=-0.3)
    position = np.random.default_rng(0).normal(size=(4, 5, 2))
    np.testing.assert_allclose(lattice.from_camera_px(lattice.to_camera_px(position)), position, atol=1e-12)


def test_slope_per_px_is_wavenumber_times_pixel_angle() -> None:
    sensor = sensor_of(3, 3)
    # One pixel over the focal length is the ray's angle; times k it is the phase slope.
    assert sensor.slope_per_px == pytest.approx(2 * math.pi / 462e-9 * 16e-6 / 46.7e-3)


def test_field_is_imaged_with_f_over_f1() -> None:
    field = Field(collimator_focal_length_m=0.2, half_width_m=0.6e-3)
    assert field.half_width_px(sensor_of(3, 3)) == pytest.approx(0.6e-3 * 46.7e-3 / 0.2 / 16e-6)


@pytest.mark.parametrize("shape", ["square", "circle"])
def test_outline_goes_around_the_field(shape: Literal["square", "circle"]) -> None:
    """It comes near the edge in every direction: half of an octant away at most."""
    field = Field(collimator_focal_length_m=0.2, half_width_m=0.6e-3, shape=shape)
    outline, angle = field.outline, np.linspace(0, 2 * math.pi, 181)
    assert field.contains(*outline.T).all()
    reach = np.max(outline @ (np.cos(angle), np.sin(angle)), axis=0)
    assert reach.min() > math.cos(math.pi / 8) - 1e-9
    assert np.count_nonzero(np.all(outline == 0, axis=1)) == 1


def test_views_outside_the_field_are_refused() -> None:
    with pytest.raises(ValueError, match="view_spacing_m places views outside"):
        Field(collimator_focal_length_m=0.2, half_width_m=0.6e-3, view_spacing_m=1e-3)
