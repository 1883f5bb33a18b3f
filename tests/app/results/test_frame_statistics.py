"""Histogram and clipped pixels of frames, made up and from the simulated detector."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from app.results.frame_statistics import frame_statistics

FULL_SCALE = 65535


def light(peak: float, noise: float, seed: int = 0) -> NDArray[np.float64]:
    """Smooth squares of light with noise, before any clipping."""
    x = np.arange(300) % 30 - 14.5
    profile = 0.5 * (np.tanh((x + 8) / 2) - np.tanh((x - 8) / 2))
    return 500 + peak * np.outer(profile, profile) + np.random.default_rng(seed).normal(0, noise, (300, 300))


def counts(values: NDArray[np.float64], most: float = FULL_SCALE) -> NDArray[np.uint16]:
    return np.clip(np.rint(values), 0, most).astype(np.uint16)


def test_histogram_counts_every_pixel_once() -> None:
    pixels = np.random.default_rng(1).integers(0, 4096, (40, 50), np.uint16)
    found = frame_statistics(pixels, 4095)
    expected, _ = np.histogram(pixels, found.level)
    np.testing.assert_array_equal(found.pixels, expected)
    assert found.pixels.sum() == pixels.size
    assert found.peak == pixels.max()
    np.testing.assert_allclose(found.usual, np.percentile(pixels, (1, 99.8)), atol=3)


@pytest.mark.parametrize("peak", [1000, 20000, 50000, 60000])
@pytest.mark.parametrize("noise", [30, 300])
def test_unclipped_light_is_not_clipped(peak: float, noise: float) -> None:
    for seed in range(20):
        found = frame_statistics(counts(light(peak, noise, seed), FULL_SCALE), FULL_SCALE)
        if found.peak < FULL_SCALE:
            assert found.clip_level == FULL_SCALE
            assert found.clipped_share == 0


def test_full_scale_clips() -> None:
    values = light(80000, 300)
    found = frame_statistics(counts(values), FULL_SCALE)
    assert found.clip_level == FULL_SCALE
    assert found.clipped_share == pytest.approx(np.mean(values >= FULL_SCALE - 0.5))
    assert found.is_nearly_full


@pytest.mark.parametrize("read_noise", [0.0, 10.0])
def test_full_well_below_full_scale_clips(read_noise: float) -> None:
    well = np.minimum(light(90000, 300), 60000.0)
    noise = np.random.default_rng(3).normal(0, read_noise, well.shape)
    found = frame_statistics(counts(well + noise), FULL_SCALE)
    assert 59800 < found.clip_level <= 60000
    assert found.clipped_share == pytest.approx(np.mean(well >= 60000), rel=0.02)


def test_warning_begins_at_95_percent() -> None:
    pixels = counts(light(10000, 0))
    for peak, is_nearly_full in ((0.94 * FULL_SCALE, False), (0.96 * FULL_SCALE, True)):
        pixels[3, 4] = round(peak)
        assert frame_statistics(pixels, FULL_SCALE).is_nearly_full is is_nearly_full


def test_unknown_full_scale_clips_nothing() -> None:
    found = frame_statistics(np.full((4, 4), 7, np.uint16), 0)
    assert found.clipped_share == 0
    assert found.pixels.sum() == 16
