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


def prepared(arrangement: Arrangement = "square", lit: Booleans | None = None) -> tuple[StrayLight, Floats, Floats]:
    """The measurement, the flattened reference, counts above the dark, and the place of each pixel, (pixel, xy)."""
    sensor = replace(SmallBench(9, 9).sensor, lenslet_rows=ROWS, lenslet_columns=COLUMNS, arrangement=arrangement)
    lit = np.ones((ROWS, COLUMNS), np.bool_) if lit is None else lit
    place = lenslet_centers(arrangement, ROWS, COLUMNS)[lit]
    light = np.tile([BRIGHTEST, 500.0, 20, 10, 5, 0, 30, 40], (len(place), 1))  # two of the samples lie in the opening
    stray = StrayLight(sensor, lit=lit, light=light, is_good=np.ones(light.shape, np.bool_))
    return stray, light.ravel(), np.repeat(place, SAMPLES, axis=0)


def rise(stray: StrayLight, added: Floats) -> float:
    """Rise in a frame with that more light in each pixel, (pixel,), than the reference."""
    return stray.rise(np.sum(added.reshape(stray.gaps.shape), axis=1, where=stray.gaps))


@pytest.mark.parametrize("arrangement", ["square", "hexagonal"])
def test_rise_is_that_of_the_plane(arrangement: Arrangement) -> None:
    stray, frame, place = prepared(arrangement)
    plane = 40 + place @ (3.0, -4.0)  # counts, 5 per pitch
    assert rise(stray, plane) == pytest.approx(5 / BRIGHTEST)
    assert rise(stray, np.full(frame.shape, 40.0)) == pytest.approx(0, abs=1e-12)


def test_light_in_the_openings_is_no_stray_light() -> None:
    stray, frame, place = prepared()
    inside = frame > BRIGHTEST / 10
    assert rise(stray, inside * (place @ (30.0, 0.0))) == pytest.approx(0, abs=1e-12)


def test_chance_is_no_rise() -> None:
    """Planes fitted to noise exceed one standard error, but never five."""
    stray, frame, _ = prepared()
    generator = np.random.default_rng(0)
    assert all(rise(stray, generator.normal(0, 50, frame.shape)) == 0 for _ in range(100))


def test_rise_is_unknown_with_few_lenslets_or_those_of_one_row() -> None:
    for lit in (np.indices((ROWS, COLUMNS))[0] == 2, np.indices((ROWS, COLUMNS)).sum(axis=0) < 3):
        stray, _, place = prepared(lit=lit)
        assert math.isclose(rise(stray, place @ (30.0, 0.0)), 0)


def test_spots_are_the_change_between_neighbours() -> None:
    """Light that alternates by 30 counts, and a plane of 3 counts per pitch along x."""
    stray, frame, place = prepared()
    alternating = 15.0 * np.where(np.sum(np.rint(place - place.min(axis=0)), axis=1) % 2, 1, -1)
    for added, change in ((alternating, 30 / BRIGHTEST), (np.full(frame.shape, 40.0), 0.0)):
        sums = np.sum(added.reshape(stray.gaps.shape), axis=1, where=stray.gaps)
        assert stray.spots(sums) == pytest.approx(change, abs=1e-12)
