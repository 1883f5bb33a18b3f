"""Solve over assumed layers: prepared once, it gives what a fit of the whole problem gives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.optics import SmallBench

from reconstruction.displacement import Displacement, Outcome
from reconstruction.errors import ReconstructionError
from reconstruction.layers.layered_wavefront import AssumedSample
from reconstruction.pipeline import Reconstructor


@pytest.fixture(scope="module")
def reconstructor(paper_bench: SmallBench) -> Reconstructor:
    return paper_bench.reconstructor("cubic", pupil_modes=None, sample="layers")


@pytest.fixture(scope="module")
def displacement(paper_bench: SmallBench, reconstructor: Reconstructor) -> Displacement:
    """Displacements by the phase 3 s^2 - 2 s t of one layer."""
    half_width_m = paper_bench.sensor.pupil_half_width_m[0]
    u, v = paper_bench.samples()

    def phase(x_m: float, y_m: float) -> np.ndarray:
        s, t = (u - 0.8 * x_m) / half_width_m, (v - 0.8 * y_m) / half_width_m
        return (3 * s**2 - 2 * s * t).astype("f4")

    return reconstructor.register(paper_bench.frame(phase))


def without(displacement: Displacement, *lenslets: tuple[int, int]) -> Displacement:
    outcome = displacement.outcome.copy()
    for lenslet in lenslets:
        outcome[lenslet] = Outcome.DARK
    return replace(displacement, outcome=outcome)


@pytest.mark.parametrize("ratios", [(-0.8,), (-0.8, 0.3)])
@pytest.mark.parametrize("lost", [[], [(0, 0), (3, 4)]])
def test_prepared_solve_equals_the_fit_of_the_whole_problem(
    reconstructor: Reconstructor,
    displacement: Displacement,
    ratios: tuple[float, ...],
    lost: tuple[tuple[int, int], ...],
) -> None:
    frame = without(displacement, *lost)
    half_m = reconstructor.field.half_width_m
    for _ in range(2):  # the second one is remembered
        wavefront = reconstructor.solve(frame, sample=AssumedSample(ratios))
        fit = reconstructor.layers(frame).fit(*ratios)
        for x, y in ((0.0, 0.0), (0.5, -0.8)):
            expected = fit.wavefront(reconstructor.sensor, x * half_m, y * half_m)
            found = wavefront.at(x * half_m, y * half_m)
            np.testing.assert_allclose(found, expected - np.mean(expected), rtol=0, atol=2e-3)


def test_layered_solve_needs_lenslets(reconstructor: Reconstructor, displacement: Displacement) -> None:
    few = without(displacement, *np.ndindex(6, 9))
    with pytest.raises(ReconstructionError, match="layers need at least 9 valid lenslets"):
        reconstructor.solve(without(few, (6, 0)), sample=AssumedSample((-0.8,)))
    assert np.isfinite(reconstructor.solve(few, sample=AssumedSample((-0.8,))).views).any()
