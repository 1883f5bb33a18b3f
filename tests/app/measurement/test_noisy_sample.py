"""In noise, a layer is sought behind the lenslets only if none before them explains the frame."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from app.bench.config import load_bench
from app.evaluation.frames import simulate
from app.measurement.offline_reconstructor import reconstructor as reconstructor_of
from reconstruction.wavefront import rms

SETTINGS = (
    "simulation.source.mask=square",
    "registration.warp=quadratic",
    "simulation.seed=172",
    "simulation.screen.rms_rad=0.8",
)
PEAK_E, READ_NOISE_E, BIAS = 250.0, 4.0, 400


@pytest.mark.slow
@pytest.mark.parametrize("draw", [2, 4])  # the evidence is higher behind the lenslets, by 7 and 15
def test_dim_frame_of_a_layer_before_the_lenslets(draw: int) -> None:
    bench = load_bench("small_demo", SETTINGS)
    images, rng = simulate(bench, noise_free=True), np.random.default_rng(draw)

    def exposed(photons: NDArray[np.float32]) -> NDArray[np.uint16]:
        mean_e = np.asarray(photons, np.float64) * (PEAK_E / float(images.reference.max()))
        counts = rng.poisson(mean_e) + rng.normal(0, READ_NOISE_E, mean_e.shape)
        return np.rint(counts + BIAS).clip(0).astype(np.uint16)

    reference, frame = exposed(images.reference), exposed(images.frames[0])
    dark = np.full_like(reference, BIAS)
    wavefront = reconstructor_of(bench, reference, dark=dark, frame=frame)(frame)
    (ratio,) = wavefront.sample.ratios
    assert ratio == pytest.approx(-0.975, abs=0.5)  # its distance over the focal length of the collimator
    error_rad = float(np.sqrt(np.nanmean(rms(wavefront.views - images.truth) ** 2)))
    assert error_rad < 2 * float(np.sqrt(np.nanmean(wavefront.sigma() ** 2)))
