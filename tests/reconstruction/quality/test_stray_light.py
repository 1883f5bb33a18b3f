"""Rise of stray light between the openings, against planes that are added to the light of a reference."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from support.optics import SmallBench

from reconstruction.arrays import Booleans, Floats
from reconstruction.geometry import Arrangement, lenslet_centers
from reconstruction.quality.frame_quality import StrayLight

ROWS, COLUMNS, SAMPLES, BRIGHTEST = 5, 6, 8, 1000.0
DARK = 300.0


def prepared(
    arrangement: Arrangement = "square", lit: Booleans | None = None, uneven: tuple[float, float] = (0, 0)
) -> tuple[StrayLight, Floats, Floats]:
    """The measurement, the flattened reference frame, counts, and the place of each of its pixels, (pixel, xy).

    The light of the reference rises by the parts `uneven` per pitch.
    """
    sensor = replace(SmallBench(9, 9).sensor, lenslet_rows=ROWS, lenslet_columns=COLUMNS, arrangement=arrangement)
    lit = np.ones((ROWS, COLUMNS), np.bool_) if lit is None else lit
    place = lenslet_centers(arrangement, ROWS, COLUMNS)[lit]
    light = np.tile([BRIGHTEST, 500.0, 20, 10, 5, 0, 30, 40], (len(place), 1))  # two of the samples lie in the opening
    light *= 1 + place @ np.array([uneven]).T
    sampled = np.arange(light.size).reshape(light.shape)
    is_good = np.ones(light.shape, np.bool_)
    stray = StrayLight(sensor, lit=lit, light=light, sampled=sampled, is_good=is_good, dark=DARK)
    return stray, (light + DARK).ravel(), np.repeat(place, SAMPLES, axis=0)


@pytest.mark.parametrize("arrangement", ["square", "hexagonal"])
def test_rise_is_that_of_the_plane(arrangement: Arrangement) -> None:
    stray, frame, place = prepared(arrangement)
    plane = 40 + place @ (3.0, -4.0)  # counts, 5 per pitch
    assert stray.rise(frame + plane) == pytest.approx(5 / BRIGHTEST)
    assert stray.rise(frame + 40) == pytest.approx(0, abs=1e-12)


def test_rise_that_the_reference_has_too_is_no_rise() -> None:
    """A beam off centre lights the gaps as unevenly as the openings."""
    stray, frame, _ = prepared(uneven=(0.1, -0.05))
    assert stray.rise(frame) == pytest.approx(0, abs=1e-12)


def test_light_in_the_openings_is_no_stray_light() -> None:
    stray, frame, place = prepared()
    inside = frame > DARK + BRIGHTEST / 10
    assert stray.rise(frame + inside * (place @ (30.0, 0.0))) == pytest.approx(0, abs=1e-12)


def test_chance_is_no_rise() -> None:
    """Planes fitted to noise exceed one standard error, but never five."""
    stray, frame, _ = prepared()
    generator = np.random.default_rng(0)
    assert all(stray.rise(frame + generator.normal(0, 50, frame.shape)) == 0 for _ in range(100))


def test_rise_is_unknown_with_few_lenslets_or_those_of_one_row() -> None:
    for lit in (np.indices((ROWS, COLUMNS))[0] == 2, np.indices((ROWS, COLUMNS)).sum(axis=0) < 3):
        stray, frame, place = prepared(lit=lit)
        assert math.isclose(stray.rise(frame + place @ (30.0, 0.0)), 0)
