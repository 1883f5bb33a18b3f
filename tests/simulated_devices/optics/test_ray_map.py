"""Rays at the screen and the resulting wavefront, against the geometry of physics.md, section 2."""

from __future__ import annotations

import numpy as np
import pytest
from support.optics import sensor_of

from reconstruction.geometry import Field
from simulated_devices.optics.phase_screen import PhaseScreen
from simulated_devices.optics.screen_light import RayMap, truth_wavefront

SENSOR = sensor_of(7, 9)
FIELD = Field(collimator_focal_length_m=0.2, half_width_m=0.6e-3, view_rows=2, view_columns=3, view_spacing_m=0.5e-3)


def plane_and_bowl(slope_x: float, slope_y: float, bend_x: float) -> PhaseScreen:
    along_m = (np.arange(321) - 160) * 25e-6
    x, y = along_m[None, :], along_m[:, None]
    return PhaseScreen(slope_x * x + slope_y * y + bend_x * x**2, 25e-6)


def test_collimated_beam_keeps_pupil_scale() -> None:
    rays = RayMap.near_pupil(distance_m=0.195, collimator_focal_length_m=0.2)
    assert rays.pupil_scale == 1
    assert rays.field_scale == rays.ratio == pytest.approx(-0.975)


def test_ray_scales_near_source_depend_on_distance() -> None:
    rays = RayMap.near_source(distance_m=0.02, collimator_focal_length_m=0.2)
    # In the mask's own plane a ray is where its object point is; at the collimator it is where its pupil point is.
    assert (rays.pupil_scale, rays.field_scale) == pytest.approx((0.1, -0.9))
    at_mask = RayMap.near_source(distance_m=0.0, collimator_focal_length_m=0.2)
    assert (at_mask.pupil_scale, at_mask.field_scale) == (0.0, -1.0)
    at_collimator = RayMap.near_source(distance_m=0.2, collimator_focal_length_m=0.2)
    assert (at_collimator.pupil_scale, at_collimator.field_scale) == pytest.approx((1.0, 0.0))


def test_footprint_is_pupil_plus_field() -> None:
    rays = RayMap(pupil_scale=-0.5, field_scale=2.0)
    np.testing.assert_allclose(rays.footprint_half_width_m((4.0, 3.0), 1.0), [4.0, 3.5])


def test_truth_of_plane_and_bowl_matches_closed_form() -> None:
    slope_x, slope_y, bend_x = 3000.0, -1000.0, 2e6
    rays = RayMap.near_pupil(distance_m=0.1, collimator_focal_length_m=0.2)
    shift_x, shift_y = 0.2e-3, -0.3e-3
    wavefront = truth_wavefront(plane_and_bowl(slope_x, slope_y, bend_x), rays, SENSOR, FIELD, (shift_x, shift_y))
    assert wavefront.shape == (2, 3, 7, 9)
    u = (np.arange(9) - 4) * 0.5e-3
    v = (np.arange(7) - 3) * 0.5e-3
    for row, y_o in enumerate((-0.25e-3, 0.25e-3)):
        for column, x_o in enumerate((-0.5e-3, 0.0, 0.5e-3)):
            x, y = u - 0.5 * x_o - shift_x, v - 0.5 * y_o - shift_y
            expected = slope_x * x[None, :] + slope_y * y[:, None] + bend_x * x[None, :] ** 2
            np.testing.assert_allclose(wavefront[row, column], expected - expected.mean(), atol=1e-9)


def test_piston_is_removed_from_every_view() -> None:
    rays = RayMap.near_pupil(distance_m=0.195, collimator_focal_length_m=0.2)
    wavefront = truth_wavefront(plane_and_bowl(3000.0, 500.0, 1e6), rays, SENSOR, FIELD)
    np.testing.assert_allclose(wavefront.mean(axis=(2, 3)), 0.0, atol=1e-12)
