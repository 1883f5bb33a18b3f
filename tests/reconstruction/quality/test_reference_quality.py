"""Verdicts on references and darks."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from support.optics import SmallBench
from support.spot_frames import spots

from reconstruction.arrays import Counts
from reconstruction.frame.noise import CameraNoise, KnownNoise
from reconstruction.frame.pixels import KnownCamera, clipped_fraction
from reconstruction.geometry import Lattice
from reconstruction.lattice.search import survey
from reconstruction.quality.reference_quality import lattice_error_px, lit_elsewhere, reference_quality
from reconstruction.quality.verdict import Fault, Quality, sequence_quality

BENCH = SmallBench()
LIGHT = np.asarray(BENCH.reference / BENCH.reference.max() * 1e4, np.float32)
UNKNOWN = KnownCamera()
NOISY = KnownCamera(noise=KnownNoise(CameraNoise(counts_per_electron=1.0, read_noise_counts=8.0), 1))


def quality(reference: Counts = LIGHT, camera: KnownCamera = UNKNOWN, **more: Any) -> Quality:
    return reference_quality(reference, sensor=BENCH.sensor, lattice=BENCH.lattice, camera=camera, **more)


STALE = {
    "half a pitch off": {"center_x_px": BENCH.lattice.center_x_px + 15.6},
    "8 px off": {"center_y_px": BENCH.lattice.center_y_px - 8},
    "5 degrees": {"rotation_rad": math.radians(5)},
    "4 % of the pitch": {"pitch_px": BENCH.lattice.pitch_px * 1.04},
    "45 degrees": {"rotation_rad": math.radians(45)},
}


@pytest.mark.parametrize("change", STALE.values(), ids=STALE)
def test_stale_lattice_is_found(change: dict[str, Any]) -> None:
    shown = survey(LIGHT, BENCH.sensor).lattice
    stale = replace(BENCH.lattice, **change)
    found = reference_quality(LIGHT, sensor=BENCH.sensor, lattice=stale, shown=shown, camera=UNKNOWN)
    assert found.faults == Fault.LATTICE
    assert "calibrate again" in found.sentence
    assert "unless the mask is asymmetric" in found.sentence


@pytest.mark.parametrize(("columns", "rows"), [(1, 0), (0, -1), (-2, 1)])
def test_lattice_off_by_whole_pitches_is_found(columns: int, rows: int) -> None:
    """Its subimages are perfect, but a row or column of the sensor's lenslets is missing."""
    shown, lattice = survey(LIGHT, BENCH.sensor).lattice, BENCH.lattice
    x_px, y_px = lattice.to_camera_px(np.array([columns, rows], np.float64) * lattice.pitch_px)
    stale = replace(lattice, center_x_px=x_px, center_y_px=y_px)
    found = reference_quality(LIGHT, sensor=BENCH.sensor, lattice=stale, shown=shown, camera=UNKNOWN)
    assert found.faults == Fault.LATTICE
    missing = 7 * 9 - (7 - abs(rows)) * (9 - abs(columns))
    assert f"shows {missing} more lenslets whole pitches away from [lattice]" in found.sentence


def test_block_of_a_larger_array_passes_anywhere() -> None:
    """An array with more lenslets than the sensor's: each block of them is right."""
    sensor = replace(BENCH.sensor, lenslet_rows=5, lenslet_columns=7)
    shown, pitch_px = BENCH.lattice, BENCH.lattice.pitch_px
    beside = replace(shown, center_x_px=shown.center_x_px + pitch_px, center_y_px=shown.center_y_px - pitch_px)
    assert not reference_quality(LIGHT, sensor=sensor, lattice=beside, shown=shown, camera=UNKNOWN).reasons


def test_few_missing_lenslets_pass() -> None:
    """As many as a vignetted corner; the limit is a quarter of a side."""
    moved = replace(BENCH.lattice, center_x_px=BENCH.lattice.center_x_px + BENCH.lattice.pitch_px)
    row, column = np.indices(LIGHT.shape)
    last = BENCH.lattice.from_camera_px(np.stack([column, row], axis=-1).astype(np.float64)) / BENCH.lattice.pitch_px
    for lit, is_found in ((1, False), (2, True)):
        light = np.where((last[..., 0] < -3.5) & (last[..., 1] > lit - 3.5), 0, LIGHT)
        found = reference_quality(light, sensor=BENCH.sensor, lattice=moved, shown=BENCH.lattice, camera=UNKNOWN)
        assert found.faults == (Fault.LATTICE if is_found else Fault(0)), lit


@pytest.mark.parametrize(("off", "is_found"), [(0.045, False), (0.055, True)])
def test_lattice_may_be_off_by_a_twentieth_of_a_pitch(off: float, is_found: bool) -> None:
    other = replace(BENCH.lattice, center_y_px=BENCH.lattice.center_y_px + off * BENCH.lattice.pitch_px)
    assert quality(shown=other).faults == (Fault.LATTICE if is_found else Fault(0))


def test_right_lattice_passes() -> None:
    assert not quality(shown=survey(LIGHT, BENCH.sensor).lattice).reasons


def test_lattice_error_of_a_shift_and_a_turn_about_the_middle() -> None:
    lattice = Lattice(center_x_px=150.0, center_y_px=120.0, pitch_px=31.0)
    moved = replace(lattice, center_x_px=150.0 + 2 * 31.0 + 3, center_y_px=120.0 - 31.0 - 4)
    assert lattice_error_px(lattice, moved, BENCH.sensor) == pytest.approx(5.0)
    turned = replace(lattice, rotation_rad=0.01)
    corner_px = math.hypot(3, 4) * 31.0  # 7 x 9 lenslets
    assert lattice_error_px(lattice, turned, BENCH.sensor) == pytest.approx(2 * math.sin(0.005) * corner_px, rel=1e-6)


@pytest.mark.parametrize(("leak", "is_found"), [(0.0, False), (0.009, False), (0.012, True), (0.03, True), (0.2, True)])
def test_light_in_the_dark_is_measured(leak: float, is_found: bool) -> None:
    rng = np.random.default_rng(0)
    dark = 500 + leak * LIGHT + rng.normal(0, 8, LIGHT.shape)
    found = quality(np.asarray(500 + LIGHT, np.float32), KnownCamera(dark))
    assert found.faults == (Fault.DARK if is_found else Fault(0))
    if is_found:
        assert f"contains {100 * leak:.0f} %" in found.sentence


def test_dark_brighter_than_the_reference_is_found() -> None:
    assert "brighter than the reference" in quality(camera=KnownCamera(np.full(LIGHT.shape, 65535, np.uint16))).sentence


def test_clipped_reference_is_found_but_a_bright_one_passes() -> None:
    """Clipped below full scale: read noise blurs the edge."""
    rng = np.random.default_rng(0)
    noisy = 100 + rng.poisson(LIGHT).astype(np.float32)
    clipped = np.minimum(noisy, 6000) + rng.normal(0, 8, LIGHT.shape)
    share = np.mean(noisy >= 6000)
    assert quality(np.asarray(clipped, np.uint16), NOISY).faults == Fault.CLIPPED
    assert clipped_fraction(np.asarray(clipped, np.uint16), scatter=77.0, read_noise=0.0) == pytest.approx(
        share, rel=0.15
    )
    assert not quality(np.asarray(noisy, np.uint16), NOISY).reasons
    assert not quality(np.asarray(noisy / 50, np.uint8)).reasons
    assert not quality(LIGHT).reasons


@pytest.mark.parametrize(("read_noise", "peak_e"), [(37.0, 1e4), (20.0, 3e3), (8.0, 1e3)])
def test_read_noise_blurs_the_edge_of_clipping(read_noise: float, peak_e: float) -> None:
    """Clipped at 60 % of the peak before the read noise, mean of three frames; the same light, not clipped, passes."""
    noise, rng = CameraNoise(counts_per_electron=1.0, read_noise_counts=read_noise), np.random.default_rng(0)
    photons = rng.poisson(LIGHT / 1e4 * peak_e, (3, *LIGHT.shape))
    added = 500 + rng.normal(0, read_noise, photons.shape)
    for full_well, faults in ((0.6 * peak_e, Fault.CLIPPED), (np.inf, Fault(0))):
        reference = np.mean(np.minimum(photons, full_well) + added, axis=0)
        found = quality(reference, KnownCamera(np.full(LIGHT.shape, 500.0), noise=KnownNoise(noise, 3)))
        assert found.faults == faults


def test_identical_frames_of_a_reference_are_found() -> None:
    still = np.zeros(LIGHT.shape, np.float32)
    of_one, of_20 = (KnownCamera(noise=KnownNoise(reference_frames=frames)) for frames in (1, 20))
    assert quality(camera=of_20, variance=still).faults == Fault.FROZEN
    assert not quality(camera=of_one, variance=still).reasons
    assert not quality(camera=of_20, variance=still + 1).reasons


def test_frozen_camera_and_clock_that_goes_back_are_found() -> None:
    frame = np.arange(12, dtype=np.uint16).reshape(3, 4)
    other = frame.copy()
    other[2, 3] += 1
    assert not sequence_quality(frame, other, 0.1).reasons
    assert sequence_quality(frame, frame.copy(), 0.1).faults == Fault.FROZEN
    assert "back by 0.1 s" in sequence_quality(frame, other, -0.1).sentence
    assert sequence_quality(frame, frame, 0.0).faults == Fault.FROZEN | Fault.CLOCK
    assert "stood still" in sequence_quality(frame, frame, 0.0).sentence


def test_faults_join_with_one_reason_each() -> None:
    one, other = Quality({Fault.DARK: "dark"}), Quality({Fault.DARK: "dark, too", Fault.LATTICE: "stale"})
    both = one | other
    assert both.faults == Fault.DARK | Fault.LATTICE
    assert both.reasons[Fault.DARK] == "dark"
    assert set(both.sentence.split("; ")) == {"dark", "stale"}
    assert Quality() | one is not None
    assert not (Quality() | Quality()).faults


def test_lenslets_that_the_frame_cuts_do_not_lie_elsewhere() -> None:
    """One column of spots lies off the frame, and at the other side one more lies on it in part."""
    along_px = 15.0 + 30 * np.arange(-1, 6)
    centers_px = np.stack(np.meshgrid(along_px, along_px), axis=-1).reshape(-1, 2)
    light = spots(centers_px, shape=(150, 140)).astype(np.float64) - 100
    here = Lattice(center_x_px=45.0, center_y_px=75.0, pitch_px=30.0)
    sensor = replace(BENCH.sensor, lenslet_rows=5, lenslet_columns=5)
    assert lit_elsewhere(light, here, replace(here, center_x_px=75.0), sensor) == 0
    assert lit_elsewhere(light, replace(here, center_x_px=15.0), here, sensor) == 5
