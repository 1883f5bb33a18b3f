"""Camera noise in closed form and against random draws."""

from __future__ import annotations

import numpy as np
import pytest

from reconstruction.frame.noise import CameraNoise


def test_variance_is_poisson_plus_read_noise() -> None:
    rng = np.random.default_rng(0)
    light = np.array([0.0, 40.0, 4000.0])  # counts
    noise = CameraNoise(counts_per_electron=2.5, read_noise_counts=6.0)
    draws = rng.poisson(light / 2.5, (200_000, 3)) * 2.5 + rng.normal(0, 6.0, (200_000, 3))
    np.testing.assert_allclose(noise.variance(light), draws.var(axis=0), rtol=0.02)


def test_excess_noise_doubles_shot_noise_variance() -> None:
    # A long register turns each electron into an exponentially distributed number.
    rng = np.random.default_rng(0)
    electrons = rng.poisson(50.0, 200_000)
    counts = rng.gamma(np.maximum(electrons, 1), 8.0) * (electrons > 0)
    noise = CameraNoise(counts_per_electron=8.0, read_noise_counts=0.0, excess_noise=2.0)
    np.testing.assert_allclose(noise.variance(np.array([400.0])), counts.var(), rtol=0.02)


def test_dark_pixels_have_read_noise_only() -> None:
    assert CameraNoise(1.0, 3.0).variance(np.array([-5.0])) == pytest.approx(9.0)
