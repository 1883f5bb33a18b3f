"""Images of imperfect benches, and the study of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from app.acquisition.devices import scene_of
from app.bench.config import Bench, load_bench
from simulated_devices.rendering import Renderer
from studies.imperfect_bench import CASES, NONE, Imperfections, detected, imperfect_bench, imperfect_images
from studies.tables import Asked

MASK = "checkerboard"


@pytest.fixture
def bench(small_toml: Path) -> Bench:
    return load_bench(small_toml, (f"simulation.source.mask='{MASK}'",))


def test_perfect_bench_has_the_images_of_the_simulated_bench(bench: Bench) -> None:
    ((reference, frame), truth), renderer = imperfect_images(bench, NONE), Renderer(scene_of(bench))
    assert reference == pytest.approx(renderer.reference(MASK), abs=1e-4 * float(reference.max()))
    assert frame == pytest.approx(renderer.state(MASK, 0), abs=1e-4 * float(frame.max()))
    assert np.array_equal(truth, renderer.truth_wavefront(0))


def test_detector_loses_light() -> None:
    flat = np.full((80, 80), 2.0, np.float32)
    flat[:, 40:] = 1.0
    noisy, _ = detected((flat, flat), Imperfections(prnu=0.01), 1)
    assert np.std(noisy[:, 40:] / 0.5e5) == pytest.approx(0.01, rel=0.05)
    point = np.zeros((81, 81), np.float32)
    point[40, 40] = 1.0
    stray, _ = detected((point, point), Imperfections(stray_light=0.1), 1)
    assert stray[40, 40] == pytest.approx(0.9e5, rel=0.01)
    assert 0.05e5 < stray.sum() - stray[40, 40] < 0.1e5  # some of it leaves the camera
    diffuse, _ = detected((point, point), Imperfections(diffusion_px=0.35), 1)
    assert diffuse.sum() == pytest.approx(1e5, rel=1e-4)
    assert diffuse[40, 40] < 0.95e5


@pytest.mark.slow
def test_study_shows_residual_error_bar_and_flags(bench: Bench) -> None:
    chosen = [each for each in CASES if each.name in {"none", "absorption 16 %", "defocus 4 %"}]
    table, _ = imperfect_bench(Asked(bench), chosen)
    found = table.set_index(["curve", "at"])
    assert len(found) == 12
    mean_rad = found["mean_rad"]
    assert mean_rad["free", "defocus 4 %"] > 2 * mean_rad["free", "none"]
    assert mean_rad["free", "absorption 16 %"] < 1.2 * mean_rad["free", "none"]  # its brightness is fitted
    assert found.loc[("layers", "none"), "flags"] == ""
    assert "SCALE" in found.loc[("free", "defocus 4 %"), "flags"]
    assert 0 <= found.loc[("layers: error bar", "none"), "coverage"] <= 1
