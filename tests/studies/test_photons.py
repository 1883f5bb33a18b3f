"""Light and noise: scatter over draws, its error bars, and the Cramer-Rao bound."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from app.bench.config import load_bench
from reconstruction.wavefront import Wavefront
from studies.estimators import camera, scatter_of
from studies.noise import em_gain, photons
from studies.tables import Asked


def drawn(errors: np.ndarray, sigma: float, valid: np.ndarray) -> list[Wavefront]:
    """Wavefronts with those errors (draw, view_row, view_column, lenslet_row, lenslet_column)."""
    displacement = SimpleNamespace(valid=valid)
    bars = np.full(errors.shape[1:], sigma)
    wavefronts = [SimpleNamespace(views=1 + each, sigma=lambda: bars, displacement=displacement) for each in errors]
    return cast("list[Wavefront]", wavefronts)


def test_scatter_of_two_draws_is_their_difference_over_root_two() -> None:
    errors = np.ones((2, 1, 1, 4, 6)) * [1, -1, 1, -1, 1, -1]  # no piston
    errors[1] *= -3
    scatter = scatter_of(drawn(errors, 2.0, np.ones((4, 6), np.bool_)), np.ones((1, 1, 4, 6)))
    assert scatter.rms_rad == pytest.approx(4 / np.sqrt(2))
    assert scatter.coverage == 0.5


@pytest.mark.slow
def test_photons_study_compares_scatter_with_bound(small_toml: Path) -> None:
    bench = load_bench(small_toml, ("simulation.source.mask='checkerboard'",))  # there is no bound on what a mask hides
    table, _ = photons(Asked(bench), (1e3,), noise_draws=20)
    found = table.set_index("curve")
    scatter, bound, bar = (found.loc[f"cubic, 45 modes: {row}"] for row in ("scatter", "bound", "error bar"))
    assert 0.85 < scatter["mean_rad"] / bound["mean_rad"] < 1.2
    assert bar["coverage"] == pytest.approx(0.7, abs=0.08)
    assert 0.4 < found.loc["automatic warp: error bar", "coverage"] < 0.9
    assert found.loc["automatic warp", "observations"] == 3


@pytest.mark.slow
def test_gain_lifts_a_dim_frame_above_the_read_noise(small_toml: Path) -> None:
    table, _ = em_gain(Asked(load_bench(small_toml, ("simulation.source.mask='checkerboard'",))), (1.0, 30.0))
    found = table.set_index(["curve", "at"])["mean_rad"]
    dim = "37 e- read noise, 100 e-"
    assert found[dim, 30.0] < 0.7 * found[dim, 1.0]


@pytest.mark.parametrize(("em_gain", "light_e"), [(1.0, 900.0), (30.0, 100.0)])
def test_camera_noise_matches_noise_model(small_toml: Path, em_gain: float, light_e: float) -> None:
    seen = camera(load_bench(small_toml), 3, em_gain)
    electrons = np.full((200, 300), light_e, np.float32)
    counts = seen.exposed(electrons, seed=5, index=0)
    assert counts.mean() == pytest.approx(seen.counts(electrons).mean(), rel=0.01)
    assert counts.var() == pytest.approx(seen.noise.variance(seen.counts(electrons)).mean(), rel=0.03)
