"""Contours and surfaces of maps in closed form."""

from __future__ import annotations

import math

import numpy as np
import pytest

from app.results.pictures import contour_step, contours, project_surface

X, Y = np.meshgrid(np.arange(21.0), np.arange(15.0))


def test_contours_of_a_cone_are_circles_of_equal_steps() -> None:
    radius = np.hypot(X - 10, Y - 7)
    lines = contours(radius, 8.0)
    assert contour_step(8.0) == 1.0
    levels = [float(np.hypot(*(line - (10, 7)).T).mean()) for line in lines]
    assert {round(level) for level in levels} == set(range(13))
    for line, level in zip(lines, levels, strict=True):
        if level > 2:  # linear interpolation between pixels flattens the tip
            np.testing.assert_allclose(np.hypot(*(line - (10, 7)).T), round(level), atol=0.05)


def test_contours_avoid_unknown_values() -> None:
    values = X.copy()
    values[5:8, 9:12] = np.nan
    points = np.concatenate(contours(values, 10.0))
    inside = (np.abs(points[:, 0] - 10) < 1.9) & (np.abs(points[:, 1] - 6) < 1.9)
    assert not inside.any()
    assert contours(np.full((5, 5), np.nan), 1.0) == []
    assert contours(np.zeros((1, 5)), 1.0) == []


@pytest.mark.parametrize(("limit", "step"), [(8.0, 1.0), (1.0, 0.2), (0.15, 0.02), (3.0, 0.5), (160.0, 20.0)])
def test_contour_steps_are_round(limit: float, step: float) -> None:
    assert contour_step(limit) == pytest.approx(step)


def test_surface_from_above_is_the_map() -> None:
    surface = project_surface(X, 10.0, azimuth_rad=0.0, elevation_rad=math.pi / 2)
    centers = surface.corners.mean(axis=1)
    np.testing.assert_allclose(surface.values, centers[:, 0] * 20 + 10)  # mean of the corners' columns
    assert len(centers) == 20 * 14
    np.testing.assert_allclose(np.ptp(surface.corners[..., 0]), 1.0)
    np.testing.assert_allclose(np.ptp(surface.corners[..., 1]), 14 / 20)


def test_heights_rise_up_the_picture_and_the_front_is_painted_last() -> None:
    flat = project_surface(np.zeros((5, 5)), 1.0, azimuth_rad=0.0, elevation_rad=0.5)
    high = project_surface(np.ones((5, 5)), 1.0, azimuth_rad=0.0, elevation_rad=0.5)
    np.testing.assert_allclose(high.corners[..., 1] - flat.corners[..., 1], -0.25 * math.cos(0.5))
    assert (np.diff(flat.corners[:, :, 1].mean(axis=1)) > -1e-12).all()  # rows run towards the viewer, down the picture
    turned = project_surface(Y[:5, :5], 1.0, azimuth_rad=math.pi, elevation_rad=0.5)
    assert turned.values[0] == 3.5  # half a turn brings the last row to the back
    assert turned.values[-1] == 0.5


def test_face_without_a_corner_is_left_out() -> None:
    values = np.zeros((5, 5))
    values[2, 2] = np.nan
    surface = project_surface(values, 1.0, azimuth_rad=0.3, elevation_rad=0.5)
    assert len(surface.values) == 16 - 4
