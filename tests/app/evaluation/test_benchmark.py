"""The benchmark on a tiny bench: its file, the residuals of the peers, missing peers and the baseline."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from app import cli
from app.bench.config import Bench, load_bench
from app.commands.benchmark import print_benchmark
from app.evaluation.benchmark import Json, load_baseline, run_benchmark, worsened
from app.evaluation.benchmark.contestants import OURS, PEERS, Register
from app.evaluation.benchmark.timed_frames import noise_free, side_by_side, tiled
from app.run_facts import write_record
from reconstruction.settings import RegistrationSettings
from reconstruction.wavefront import rms

RATIOS = {"simpleitk_affine", "opencv_ecc_affine", "skimage_phase_correlation", "pyrtc_correlation"}


@pytest.fixture(scope="module")
def bench() -> Bench:
    sizes = {"sensor.lenslet_rows": 5, "sensor.lenslet_columns": 5, "camera.rows": 155, "camera.columns": 155}
    middle = {"lattice.center_x_px": 77.0, "lattice.center_y_px": 77.0}
    coarse = {"simulation.object_samples": 13, "simulation.pupil_samples": 10, "reconstruction.pupil_modes": 15}
    changes = {**sizes, **middle, **coarse, "simulation.screen.rms_rad": 2.0}
    return load_bench("paper_simulation", tuple(f"{key}={value}" for key, value in changes.items()))


@pytest.fixture(scope="module")
def result(bench: Bench) -> Json:
    return run_benchmark(bench, lambda *_: None, budget_s=0.02, sizes=(3,), with_four_k=False)


@pytest.mark.slow
@pytest.mark.long
def test_benchmark_is_written_and_printed(result: Json, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_record(tmp_path / "benchmark.json", result)
    written = json.loads((tmp_path / "benchmark.json").read_text())
    assert set(written["ratios"]) == RATIOS
    assert all(ratio > 0 for ratio in written["ratios"].values())
    assert written["frames_per_s"] > 0
    assert {each["lenslets"] for each in written["growth"]} == {3, 5}
    assert {each["field_modes"] for each in written["growth"]} == {3, 6, 10}
    assert written["zonal"]["largest_difference_rad"] < 1e-9
    assert 0 < written["layer"]["known_s"] < written["layer"]["search_s"]
    assert written["forward"]["ours_s_per_point"] > 0
    assert set(written["missing"]) <= {"hcipy"}
    assert written["machine"]["cores"] >= 1
    print_benchmark(result)
    assert OURS in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.long
def test_svwfs_measures_the_wavefront_better_than_peers(result: Json, bench: Bench) -> None:
    truth = noise_free(bench).truth
    assert truth is not None
    for kind in ("noise_free", "noisy"):
        residuals = result["residuals_rad"][kind]
        assert set(residuals) >= RATIOS
        assert all(residual < 0.6 * rms(truth).mean() for residual in residuals.values())
        assert residuals[OURS] < min(residuals[name] for name in RATIOS)


@pytest.mark.slow
@pytest.mark.long
def test_missing_peer_is_reported(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(*_: object) -> Register:
        raise ImportError("No module named 'skimage'")

    monkeypatch.setitem(PEERS, "skimage_phase_correlation", missing)
    peers = ("skimage_phase_correlation", "opencv_ecc_affine")
    found = run_benchmark(bench, lambda *_: None, budget_s=0.01, sizes=(), with_four_k=False, peers=peers)
    assert set(found["ratios"]) == {"opencv_ecc_affine"}
    assert "skimage" in found["missing"]["skimage_phase_correlation"]


def test_ratios_more_than_a_fifth_slower_have_worsened() -> None:
    before = {"a": 100.0, "b": 10.0, "c": 1.0}
    assert worsened({"a": 81.0, "b": 12.0, "c": 1.0}, before) == []
    said = worsened({"a": 79.0, "b": 12.0}, before)
    assert [text.partition(":")[0] for text in said] == ["a", "c"]


def test_baseline_holds_the_measured_ratios() -> None:
    assert set(load_baseline()) == RATIOS


@pytest.mark.parametrize(("factor", "status"), [(1.0, 0), (0.5, 1)])
def test_check_sets_the_exit_status(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, factor: float, status: int
) -> None:
    ratios = {name: ratio * factor for name, ratio in load_baseline().items()}
    printed = list[Json]()
    monkeypatch.setattr("app.evaluation.benchmark.run_benchmark", lambda *_: {"ratios": ratios})
    monkeypatch.setattr("app.commands.benchmark.print_benchmark", printed.append)
    monkeypatch.setattr(sys, "argv", ["svwfs", "benchmark", "--check", "--json", str(tmp_path / "out.json")])
    with pytest.raises(SystemExit) as leaving:
        cli.main()
    assert int(leaving.value.code or 0) == status
    assert printed == [{"ratios": ratios}]
    assert json.loads((tmp_path / "out.json").read_text())["ratios"] == ratios


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


@pytest.mark.slow
def test_stopwatch_calls_contestants_in_turn() -> None:
    calls: list[str] = []
    times = side_by_side({name: lambda name=name: calls.append(name) for name in "ab"}, 0.01)  # type: ignore[misc] # bound now
    assert calls[:2] == ["a", "b"]  # once each, before any is timed
    assert list(times) == ["a", "b"]
    assert all(len(seconds) >= 3 for seconds in times.values())
