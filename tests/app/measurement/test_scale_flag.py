"""Wavefronts are flagged if the mask's image in the reference is not as large, or does not lie, as the bench says."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest

from app.bench.config import Bench, load_bench
from app.evaluation.frames import simulate
from app.measurement.offline_reconstructor import reconstructor as reconstructor_of
from reconstruction.quality.verdict import Fault, Quality
from simulated_devices.settings import Source


def judged(true: Bench, told: Bench) -> Quality:
    """The quality of a frame of one bench that is reconstructed with another."""
    images = simulate(true)
    frame = images.frames[0]
    reconstructor = reconstructor_of(replace(told, lattice=None), images.reference, dark=images.dark, frame=frame)
    return reconstructor.quality(frame, reconstructor(frame))


def out_of_focus(bench: Bench, share: float) -> Bench:
    """The camera lies behind the focus, so that images are larger; their blur is that of the shifted lenslet."""
    sensor = bench.sensor
    return replace(bench, sensor=replace(sensor, lenslet_focal_length_m=(1 + share) * sensor.lenslet_focal_length_m))


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize("mask", ["square", "circle", "checkerboard", "optimised"])
def test_wrong_scale_is_flagged_and_a_small_one_is_not(mask: str) -> None:
    bench = load_bench("small_demo", (f"simulation.source.mask='{mask}'",))
    for share in (0.0, 0.005, -0.005):
        assert Fault.SCALE not in judged(out_of_focus(bench, share), bench).faults
    found = judged(out_of_focus(bench, 0.04), bench)
    assert re.search(r"(3\.9|4\.0|4\.1) % larger than the bench", found.reasons[Fault.SCALE])
    assert "smaller than the bench" in judged(out_of_focus(bench, -0.02), bench).reasons[Fault.SCALE]


@pytest.mark.slow
@pytest.mark.long
def test_bench_that_does_not_describe_its_mask_is_not_judged() -> None:
    """Field and mask are 5 % larger than the square that stands in for a `[simulation.source]` that is left out."""
    larger = ("field.half_width_m=0.63e-3", "simulation.source.half_width_m=0.63e-3")
    bench = load_bench("small_demo", ("simulation.source.mask=square", *larger))
    left_out = replace(bench, simulation=replace(bench.simulation, source=Source()))
    assert Fault.SCALE not in judged(bench, left_out).faults
    named = replace(bench, simulation=replace(bench.simulation, source=Source(checker_cells=7)))
    assert Fault.SCALE in judged(bench, named).faults


@pytest.mark.slow
@pytest.mark.parametrize(("setting", "change"), [("lenslet_pitch_m", "5 % smaller"), ("pixel_pitch_m", "5 % larger")])
def test_wrong_pitch_is_flagged(setting: str, change: str) -> None:
    """Whatever the mask is; 2 % pass."""
    bench = load_bench("small_demo", ("simulation.source.mask=square",))
    for share, is_found in ((1.05, True), (1.02, False)):
        sensor = replace(bench.sensor, **{setting: share * getattr(bench.sensor, setting)})
        reason = judged(bench, replace(bench, sensor=sensor)).reasons.get(Fault.SCALE, "")
        assert (f"pitch on the camera is {change} than the bench's lengths say" in reason) == is_found, reason
