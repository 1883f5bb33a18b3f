"""Verdicts on references and darks."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from support.optics import SmallBench

from reconstruction.arrays import Counts
from reconstruction.frame.noise import CameraNoise
from reconstruction.geometry import Lattice
from reconstruction.lattice.search import find_lattice
from reconstruction.quality.clipping import clipped_fraction
from reconstruction.quality.reference_quality import lattice_error_px, reference_quality
from reconstruction.quality.sequence import sequence_quality
from reconstruction.quality.verdict import Fault, Quality

BENCH = SmallBench()
LIGHT = np.asarray(BENCH.reference / BENCH.reference.max() * 1e4, np.float32)
NOISE = CameraNoise(counts_per_electron=1.0, read_noise_counts=8.0)


def quality(reference: Counts = LIGHT, **more: Any) -> Quality:
    return reference_quality(reference, sensor=BENCH.sensor, lattice=BENCH.lattice, **more)


STALE = {
    "half a pitch off": {"center_x_px": BENCH.lattice.center_x_px + 15.6},
    "8 px off": {"center_y_px": BENCH.lattice.center_y_px - 8},
    "5 degrees": {"rotation_rad": math.radians(5)},
    "4 % of the pitch": {"pitch_px": BENCH.lattice.pitch_px * 1.04},
    "45 degrees": {"rotation_rad": math.radians(45)},
}


@pytest.mark.parametrize("change", STALE.values(), ids=STALE)
def test_stale_lattice_is_found(change: dict[str, float]) -> None:
    shown = find_lattice(LIGHT, BENCH.sensor)
    stale = replace(BENCH.lattice, **change)
    found = reference_quality(LIGHT, sensor=BENCH.sensor, lattice=stale, shown=shown)
    assert found.faults == Fault.LATTICE
    assert "calibrate again" in found.sentence


def test_right_lattice_passes() -> None:
    assert not quality(shown=find_lattice(LIGHT, BENCH.sensor)).reasons


def test_lattice_error_of_a_shift_and_a_turn_about_the_middle() -> None:
    lattice = Lattice(center_x_px=150.0, center_y_px=120.0, pitch_px=31.0)
    moved = replace(lattice, center_x_px=150.0 + 2 * 31.0 + 3, center_y_px=120.0 - 31.0 - 4)
    assert lattice_error_px(lattice, moved, BENCH.sensor) == pytest.approx(5.0)
    turned = replace(lattice, rotation_rad=0.01)
    corner_px = math.hypot(3, 4) * 31.0  # 7 x 9 lenslets
    assert lattice_error_px(lattice, turned, BENCH.sensor) == pytest.approx(2 * math.sin(0.005) * corner_px, rel=1e-6)


@pytest.mark.parametrize(("leak", "is_found"), [(0.0, False), (0.005, False), (0.03, True), (0.2, True)])
def test_light_in_the_dark_is_measured(leak: float, is_found: bool) -> None:
    rng = np.random.default_rng(0)
    dark = 500 + leak * LIGHT + rng.normal(0, 8, LIGHT.shape)
    found = quality(np.asarray(500 + LIGHT, np.float32), dark=dark)
    assert found.faults == (Fault.DARK if is_found else Fault(0))
    if is_found:
        assert f"contains {100 * leak:.0f} %" in found.sentence


def test_dark_brighter_than_the_reference_is_found() -> None:
    assert "brighter than the reference" in quality(dark=np.full(LIGHT.shape, 65535, np.uint16)).sentence


def test_clipped_reference_is_found_but_a_bright_one_passes() -> None:
    """Clipped below full scale: read noise blurs the edge."""
    rng = np.random.default_rng(0)
    noisy = 100 + rng.poisson(LIGHT).astype(np.float32)
    clipped = np.minimum(noisy, 6000) + rng.normal(0, 8, LIGHT.shape)
    share = np.mean(noisy >= 6000)
    assert quality(np.asarray(clipped, np.uint16), noise=NOISE).faults == Fault.CLIPPED
    assert clipped_fraction(np.asarray(clipped, np.uint16), 77.0) == pytest.approx(share, rel=0.15)
    assert not quality(np.asarray(noisy, np.uint16), noise=NOISE).reasons
    assert not quality(np.asarray(noisy / 50, np.uint8)).reasons
    assert not quality(LIGHT).reasons


def test_identical_frames_of_a_reference_are_found() -> None:
    still = np.zeros(LIGHT.shape, np.float32)
    assert quality(variance=still, frames=20).faults == Fault.FROZEN
    assert not quality(variance=still, frames=1).reasons
    assert not quality(variance=still + 1, frames=20).reasons


def test_frozen_camera_and_clock_that_goes_back_are_found() -> None:
    frame = np.arange(12, dtype=np.uint16).reshape(3, 4)
    other = frame.copy()
    other[2, 3] += 1
    assert not sequence_quality(frame, other, 0.1).reasons
    assert sequence_quality(frame, frame.copy(), 0.1).faults == Fault.FROZEN
    assert "back by 0.1 s" in sequence_quality(frame, other, -0.1).sentence
    assert sequence_quality(frame, frame, 0.0).faults == Fault.FROZEN | Fault.CLOCK


def test_faults_join_with_one_reason_each() -> None:
    one, other = Quality({Fault.DARK: "dark"}), Quality({Fault.DARK: "dark, too", Fault.LATTICE: "stale"})
    both = one | other
    assert both.faults == Fault.DARK | Fault.LATTICE
    assert both.reasons[Fault.DARK] == "dark"
    assert set(both.sentence.split("; ")) == {"dark", "stale"}
    assert Quality() | one is not None
    assert not (Quality() | Quality()).faults
