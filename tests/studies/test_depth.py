"""Samples with depth, in noise: error bars cover 68 % of the errors; their difference to other layers counts."""

from __future__ import annotations

import numpy as np
import pytest

from app.bench.config import load_bench
from app.evaluation.frames import seeded, with_screen, with_source
from studies.depth import SAMPLES, calibrated, layered_images, next_to

DRAWS = 8  # of noise for each screen


@pytest.mark.slow
@pytest.mark.long
def test_error_bars_cover_the_errors_behind_two_and_six_layers() -> None:
    """The truth is that of light propagated from layer to layer; bars shorter by a fifth fail."""
    bench = with_screen(load_bench("small_demo", ()), rms_rad=2.5, correlation_length_m=1.5e-3)
    bench = with_source(bench, mask="checkerboard")
    shares = []
    for name in ("two", "six"):
        for screen in seeded(bench, range(2)):
            reference, frame, truth = layered_images(screen, SAMPLES[name])
            estimator, exposed = calibrated(screen, reference, 3e3)
            reconstructor = estimator.reconstructor
            displacements = [reconstructor.register(exposed(frame, draw)) for draw in range(DRAWS)]
            sample = reconstructor.find_sample(displacements[0])
            assert len(sample.ratios) == 3  # a slab
            each = [next_to(truth, reconstructor.solve(one, sample=sample)) for one in displacements]
            shares.append(np.mean([one["coverage"] for one in each]))
    assert 0.67 < np.mean(shares) < 0.80
