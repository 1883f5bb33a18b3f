"""Own wavefronts of rendered lenslets, found in their reference, and the statistics that shrink them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from support.optics import SmallBench, checkerboard
from support.own_wavefronts import Lenslets

from reconstruction.arrays import Floats
from reconstruction.registration.response import own_wavefronts, shrunk
from simulated_devices.optics.source import SourcePoints

RMS_RAD = 0.1


def found(lenslets: Lenslets) -> Floats:
    """Own wavefronts that the reference shows, rad, (wavefront, lenslet_row, lenslet_column)."""
    return own_wavefronts(lenslets.reference, lenslets.model).rad.reshape(-1, *lenslets.rad.shape[1:])


@pytest.fixture(scope="module")
def turned_bench() -> SmallBench:
    return SmallBench(rotation_rad=0.03, source=checkerboard())


@pytest.mark.parametrize(
    ("conditions", "largest_rad"),
    [({}, 0.005), ({"moved_px": 0.3}, 0.01), ({"uneven": 0.2}, 0.01), ({"electrons": 3e4}, 0.02)],
    ids=["alone", "displaced", "uneven light with an offset", "noise"],
)
def test_reference_shows_coma_and_trefoil_of_each_lenslet(
    turned_bench: SmallBench, conditions: dict[str, Any], largest_rad: float
) -> None:
    lenslets = Lenslets(turned_bench, RMS_RAD, **conditions)
    assert np.sqrt(np.mean((found(lenslets) - lenslets.rad) ** 2)) < largest_rad


def test_symmetric_blur_is_no_own_wavefront(checker_bench: SmallBench) -> None:
    defocused = Lenslets(checker_bench, RMS_RAD, orders=[(0, 2), (2, 0), (1, 1), (2, 2)])
    assert np.sqrt(np.mean(found(defocused) ** 2)) < 0.01


@pytest.mark.parametrize("electrons", [0.0, 3e3])
@pytest.mark.parametrize("source", ["checkerboard", "point"])
def test_equal_lenslets_have_none(source: str, electrons: float) -> None:
    point = SourcePoints(position_m=np.zeros((1, 2)), area_m2=np.ones(1))
    bench = SmallBench(source=point if source == "point" else checkerboard())
    assert np.sqrt(np.mean(found(Lenslets(bench, electrons=electrons)) ** 2)) < (0.03 if electrons else 0.005)


def test_few_lenslets_have_none(checker_bench: SmallBench) -> None:
    lenslets = Lenslets(checker_bench, RMS_RAD, excluded=[(row, column) for row in range(7) for column in range(2, 9)])
    assert np.count_nonzero(lenslets.reference.lit) == 14
    assert not found(lenslets).any()


@pytest.mark.parametrize("scatter", [0.0, 0.5, 1.0, 4.0])
def test_shrunk_values_are_the_best_that_are_proportional(scatter: float) -> None:
    """The best factor of measured values is s^2 / (s^2 + v), which leaves the square v s^2 / (s^2 + v) (Wiener)."""
    random = np.random.default_rng(1)
    true, noise = random.normal(0, scatter, 20_000), random.normal(0, 1, 20_000)
    left = float(np.mean((shrunk(true + noise, np.ones_like(true)) - true) ** 2))
    assert left == pytest.approx(scatter**2 / (scatter**2 + 1), rel=0.03, abs=0.01)


def test_outliers_do_not_change_scatter() -> None:
    values, variance = np.ones(50), np.full(50, 0.1)
    values[:3], variance[:3] = 100.0, 1e4
    values = shrunk(values, variance)
    assert np.abs(values[:3]).max() < 0.1
    assert values[3:] == pytest.approx(1, abs=0.1)
