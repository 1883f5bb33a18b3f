"""The pupil fitted to lenslets inside circles and annuli."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.optics import sensor_of

from app.errors import InputError
from app.results.pupil import Pupil
from reconstruction.geometry import Sensor

SQUARE, PITCH_M = sensor_of(31, 37), 500e-6


@pytest.mark.parametrize("arrangement", ["square", "hexagonal"])
@pytest.mark.parametrize(
    ("x", "y", "radius", "obscuration"), [(0, 0, 13, 0), (2.3, -1.1, 11.7, 0), (0.4, 0.2, 14, 0.3)]
)
def test_pupil_is_that_of_the_lit_lenslets(
    arrangement: str, x: float, y: float, radius: float, obscuration: float
) -> None:
    sensor: Sensor = replace(SQUARE, arrangement=arrangement)  # type: ignore[arg-type] # the names of the parameters
    true = Pupil(x * PITCH_M, y * PITCH_M, radius * PITCH_M, obscuration)
    lit = true.contains(sensor)
    u, v = np.moveaxis(sensor.lenslet_centers_m / PITCH_M, -1, 0)
    distance = np.sqrt((u - x) ** 2 + (v - y) ** 2)
    np.testing.assert_array_equal(lit, (distance <= radius) & (distance >= radius * obscuration))
    found = Pupil.fitted(sensor, lit)
    assert (found.x_m / PITCH_M, found.y_m / PITCH_M) == pytest.approx((x, y), abs=0.2)  # whole lenslets are lit
    assert found.radius_m / PITCH_M == pytest.approx(radius, abs=0.2)
    assert found.obscuration == pytest.approx(obscuration, abs=0.03)
    differ = np.count_nonzero(found.contains(sensor) != lit)
    assert differ < 0.04 * np.count_nonzero(lit)


def test_pupil_without_light_is_refused() -> None:
    with pytest.raises(InputError, match="no lenslet is valid"):
        Pupil.fitted(SQUARE, np.zeros((31, 37), np.bool_))
