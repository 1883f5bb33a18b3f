"""The benchmark on a tiny bench: its file and its frames."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from support.command_line import run

from app.bench.config import Bench, load_bench
from app.commands.benchmark import print_benchmark
from app.evaluation.benchmark import noise_free, run_benchmark, tiled
from app.run_facts import write_record
from reconstruction.settings import RegistrationSettings


@pytest.fixture(scope="module")
def bench() -> Bench:
    sizes = {"sensor.lenslet_rows": 5, "sensor.lenslet_columns": 5, "camera.rows": 155, "camera.columns": 155}
    middle = {"lattice.center_x_px": 77.0, "lattice.center_y_px": 77.0}
    coarse = {"simulation.object_samples": 13, "simulation.pupil_samples": 10, "reconstruction.pupil_modes": 15}
    changes = {**sizes, **middle, **coarse, "simulation.screen.rms_rad": 2.0}
    return load_bench("paper_simulation", tuple(f"{key}={value}" for key, value in changes.items()))


@pytest.mark.slow
@pytest.mark.long
def test_benchmark_is_written_and_printed(bench: Bench, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    result = run_benchmark(bench, lambda *_: None, budget_s=0.02, sizes=[(3, 0)])
    write_record(tmp_path / "benchmark.json", result)
    written = json.loads((tmp_path / "benchmark.json").read_text())
    assert [each["lenslets"] for each in written["lattices"]] == [5, 3]
    for each in written["lattices"]:
        assert each["frames_per_s"] == pytest.approx(1 / each["frame_s"])
        assert min(each[f"{stage}_s"] for stage in ("register", "solve", "prepare")) > 0
    assert written["layer_search_s"] > 0
    assert written["machine"]["cores"] >= 1
    print_benchmark(result)
    printed = capsys.readouterr().out
    assert "5 x 5" in printed
    assert "search for layers" in printed


def test_check_is_only_for_the_live_benchmark(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, "benchmark", "--check") == 2
    assert "are only for the live benchmark: add --live SECONDS" in capsys.readouterr().err


@pytest.mark.slow
def test_tiled_frames_repeat_their_source(bench: Bench) -> None:
    case = noise_free(bench)
    large = tiled(case, 7, margin_px=4)
    assert large.reference.shape == (7 * 31 + 8, 7 * 31 + 8)
    settings = RegistrationSettings(warp="affine")
    small_found = case.reconstructor(settings).register(case.frame).coefficients
    large_found = large.reconstructor(settings).register(large.frame).coefficients
    np.testing.assert_allclose(large_found[1:4, 1:4], small_found[1:4, 1:4], atol=1e-3)
    np.testing.assert_allclose(large_found[6, 1:4], small_found[1, 1:4], atol=0.02)  # other neighbours
