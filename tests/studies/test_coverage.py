"""Share of lenslets within one error bar: 68 % for normal errors, with all warps, in one pass and refined."""

from __future__ import annotations

import math
from itertools import count
from pathlib import Path

import numpy as np
import pytest

from app.bench.config import load_bench
from app.evaluation.frames import NoiseFreeFrames
from app.evaluation.mask_accuracy import without_prior
from app.measurement.estimator import Estimator
from reconstruction.arrays import Floats
from reconstruction.displacement import Displacement
from reconstruction.layers.layered_wavefront import FREE
from reconstruction.wavefront import Wavefront, without_piston
from studies.estimators import WARPS, camera, warp_estimator

NORMAL = math.erf(math.sqrt(0.5))
ASKED = 0.04
PEAKS_E = 100.0, 300.0  # with more light, systematic errors would count in the error bars, but not in the scatter
DRAWS, REFINED_DRAWS = 72, 16


def coverage(wavefronts: list[Wavefront], expected: Floats) -> list[float]:
    """Share of each wavefront's lenslets that are within one error bar of the expected one."""
    shares = []
    for wavefront in wavefronts:
        error = without_piston(np.where(wavefront.displacement.valid, wavefront.views - expected, np.nan))
        known = np.isfinite(error)
        shares.append(float(np.mean(np.abs(error[known]) < wavefront.sigma()[known])))
    return shares


def check(shares: list[float], uncertain: float) -> None:
    """Assert normal coverage, within what is asked and twice the uncertainty of the mean of independent draws."""
    uncertainty = float(np.std(shares, ddof=1)) / math.sqrt(len(shares))
    assert uncertainty < uncertain
    assert np.mean(shares) == pytest.approx(NORMAL, abs=ASKED + 2 * uncertainty)


@pytest.mark.slow
def test_error_bars_cover_68_percent(small_toml: Path) -> None:
    """Each warp in one pass at two light levels; refined, and as live with the bias of an older frame, at one each."""
    bench = load_bench(small_toml, ("simulation.source.mask='checkerboard'",))  # shows every displacement
    frames, mask, seen, draw = NoiseFreeFrames(bench), bench.simulation.source.mask, camera(bench, 1, 1.0), count()
    light = frames.frame(mask).photons
    in_one_pass, refined, live = [], [], []
    for number, warp in enumerate(WARPS):
        for peak_e in PEAKS_E:
            frame, reference = (image * np.float32(peak_e / light.max()) for image in (light, frames.reference(mask)))
            counts, settings = seen.counts(reference), without_prior(bench)
            estimator = warp_estimator(bench, counts, warp, reconstruction=settings, noise=seen.noise)
            solve, register = estimator.reconstructor.solve, estimator.reconstructor.register
            still = register(seen.counts(frame))
            noisy = [register(seen.exposed(frame, 1, next(draw))) for _ in range(DRAWS)]
            shares = coverage([solve(each) for each in noisy], solve(still).views)
            check(shares, 0.016)
            in_one_pass += shares
            if peak_e != PEAKS_E[number % 2]:
                continue

            def in_rounds(displacement: Displacement, estimator: Estimator = estimator) -> Wavefront:
                return estimator.solve(displacement, sample=FREE, rounds=1)[0]

            some = noisy[:REFINED_DRAWS]
            refined += coverage([in_rounds(each) for each in some], in_rounds(still).views)
            older = [estimator.refinement.bias(solve(each)).displacement for each in (still, *some[:3])]
            right = solve(still, bias=older[0]).views
            live += coverage([solve(each, bias=older[1 + at % 3]) for at, each in enumerate(noisy[3:])], right)
    for shares in (in_one_pass, refined, live):
        check(shares, 0.016)
