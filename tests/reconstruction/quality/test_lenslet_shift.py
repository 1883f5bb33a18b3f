"""Frames displaced by whole lenslets: found by the edge of the pupil, without false alarms."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from support.spots import SpotBench

from reconstruction.arrays import Booleans, Counts
from reconstruction.displacement import Displacement
from reconstruction.quality.frame_quality import QualityChecker
from reconstruction.quality.verdict import Fault, Quality
from reconstruction.registration.centroids import Centroids
from reconstruction.registration.subimages import ReferenceSubimages
from reconstruction.settings import RegistrationSettings

ROWS = COLUMNS = 12
BENCH = SpotBench(ROWS, COLUMNS, pitch_px=20.0, margin_px=50)
PITCH_PX = BENCH.lattice.pitch_px
RADII = {"filled": (-1.0, 99.0), "round": (-1.0, 5.2), "annular": (1.6, 5.2)}  # inner and outer, lenslets


def pupil_at(pupil: str, column: float = 0.0) -> Booleans:
    """Lit lenslets (row, column) of a pupil centred so many columns beside the lattice."""
    row, columns = np.indices((ROWS, COLUMNS)) - (ROWS - 1) / 2
    inner, outer = RADII[pupil]
    away = np.hypot(columns - column, row)
    return np.asarray((away > inner) & (away < outer))


def exposed(lit: Booleans, moved_px: NDArray[np.floating[Any]] | float = 0.0, seed: int = 0) -> Counts:
    """Counts of spots in Poisson noise, on a dark of 100."""
    light = BENCH.image(np.asarray(moved_px, np.float64), sigma_px=1.5, light=3000.0, lit=lit)
    return np.asarray(np.random.default_rng(seed).poisson(light + 5.0) + 95)


def judged(reference: Counts, frame: Counts) -> Quality:
    light = (reference - 100.0).astype(np.float32)
    subimages = ReferenceSubimages(light, sensor=BENCH.sensor, lattice=BENCH.lattice, field=BENCH.field)
    made = Centroids(subimages, star_x=np.zeros(1), star_y=np.zeros(1))
    checker = QualityChecker(subimages, RegistrationSettings(method="centroids"))
    displacement: Displacement = made((frame - 100.0).astype(np.float32), saturated=np.zeros(frame.shape, np.bool_))
    return checker(frame, displacement)


@pytest.mark.parametrize("pupil", RADII)
@pytest.mark.parametrize("lenslets", [(1, 0), (0, -1), (1, -1), (-2, 1)])
def test_displacement_by_whole_lenslets_is_flagged(pupil: str, lenslets: tuple[int, int]) -> None:
    """Also if the spots are displaced by a part of a lenslet besides."""
    lit = pupil_at(pupil)
    x, y = (int(each * PITCH_PX) for each in lenslets)
    quality = judged(exposed(lit), exposed(lit, np.array([x + 2.4, y - 1.7]), seed=1))
    assert f"displaced by ({x:+d}, {y:+d}) px" in quality.reasons[Fault.RANGE]


@pytest.mark.parametrize("share", [0.53, 0.56, 0.6, -0.55])
def test_displacement_by_half_a_lenslet_is_flagged(share: float) -> None:
    """Spots on the border of two cells light both, and each is taken for its neighbour's."""
    lit = pupil_at("round")
    quality = judged(exposed(lit), exposed(lit, np.array([share * PITCH_PX, 0.0]), seed=1))
    assert f"displaced by ({math.copysign(PITCH_PX, share):+.0f}, +0) px" in quality.reasons[Fault.RANGE]


@pytest.mark.parametrize("pupil", RADII)
def test_ordinary_frames_are_not_flagged(pupil: str) -> None:
    lit, column = pupil_at(pupil), np.indices((ROWS, COLUMNS))[1]
    at = np.moveaxis(np.indices((ROWS, COLUMNS))[::-1] - (ROWS - 1) / 2, 0, -1)  # (row, column, xy)
    frames = {
        "the same": exposed(lit, seed=1),
        "tilt": exposed(lit, np.array([7.0, -6.0]), seed=2),
        "defocus": exposed(lit, 1.1 * at, seed=3),
        "half blocked": exposed(lit & (column < 7), np.array([1.0, 2.0]), seed=4),
        "one column blocked": exposed(lit & (column > 1), seed=5),
        "vignetted": exposed(lit & (np.hypot(*np.moveaxis(at - [1.5, 0.0], -1, 0)) < 5.2), seed=6),
        "the light moves by half a lenslet": exposed(pupil_at(pupil, 0.6), seed=7),
    }
    for name, frame in frames.items():
        assert "of the reference, displaced by" not in judged(exposed(lit), frame).sentence, name
