"""A bench that takes real light for the paper's, or the reverse, is told so by the light of the subimages."""

from __future__ import annotations

import pytest

from app.bench.config import load_bench
from app.evaluation.frames import simulate
from app.measurement.offline_reconstructor import reconstructor as reconstructor_of
from reconstruction.quality.verdict import Fault, Quality


def judged(world: str, assumed: str, *settings: str) -> Quality:
    images = simulate(load_bench("small_demo", (f"field.neglect_propagation={world}", *settings)))
    bench = load_bench("small_demo", (f"field.neglect_propagation={assumed}",))
    frame = images.frames[0]
    reconstructor = reconstructor_of(bench, images.reference, dark=images.dark, frame=frame)
    return reconstructor.quality(frame, reconstructor(frame))


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize("mask", ["square", "checkerboard"])
@pytest.mark.parametrize("world", ["true", "false"])
def test_wrong_world_is_flagged_and_the_right_one_is_not(world: str, mask: str) -> None:
    wrong = {"true": "false", "false": "true"}[world]
    through = f"simulation.source.mask='{mask}'"
    assert Fault.PROPAGATION not in judged(world, world, through).faults
    found = judged(world, wrong, through)
    assert Fault.PROPAGATION in found.faults
    assert "neglect_propagation" in found.reasons[Fault.PROPAGATION]


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize("setting", ["simulation.screen.transmission_rms=0.15", "simulation.screen.rms_rad=0.05"])
def test_absorbing_and_weak_samples_decide_nothing(setting: str) -> None:
    for world in ("true", "false"):
        for assumed in ("true", "false"):
            assert Fault.PROPAGATION not in judged(world, assumed, setting).faults
