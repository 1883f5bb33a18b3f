"""Contours of maps in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from app.results.pictures import contour_step, contours

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
