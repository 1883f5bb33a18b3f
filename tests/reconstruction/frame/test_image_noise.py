"""Noise of a single image, from the spatial frequencies that no optics can show."""

from __future__ import annotations

import numpy as np
import pytest
from support.optics import SmallBench

from reconstruction.frame.noise import image_transfer

BENCH = SmallBench(9, 9)
LIGHT = BENCH.reference / BENCH.reference.max()


@pytest.mark.parametrize("peak_e", [200.0, 1e3, 1e4, 5e4])
def test_noise_of_one_image_is_found(peak_e: float) -> None:
    rng = np.random.default_rng(0)
    per_electron, read_noise = 0.3, 2.0
    counts = per_electron * rng.poisson(LIGHT * peak_e) + rng.normal(0, read_noise, LIGHT.shape)
    curve = image_transfer(counts.astype(np.float32), BENCH.sensor.blur_px)
    assert curve is not None
    found = curve.noise
    assert found is not None
    bright = np.array([per_electron * peak_e])
    assert found.variance(bright) == pytest.approx(per_electron * bright + read_noise**2, rel=0.12)


def test_noise_free_image_and_coarse_pixels_show_none() -> None:
    assert image_transfer(np.asarray(LIGHT * 1e4, np.float32), BENCH.sensor.blur_px) is None
    noisy = np.random.default_rng(0).poisson(LIGHT * 1e4).astype(np.float32)
    assert image_transfer(noisy, 2.0) is None
