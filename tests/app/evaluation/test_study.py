"""The study of the estimator: what the command writes, and how it ends when it cannot go on."""

from __future__ import annotations

import csv
import json
import math
import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.pictures import assert_drawn

import app.cache
from app.bench.config import Bench, load_bench
from app.cache import cache_folder, remembered
from app.cli import main
from app.evaluation.noise_free import NoiseFreeFrames
from app.evaluation.study import sweeps
from app.evaluation.study.estimators import mean_rms
from app.evaluation.study.noise import camera
from app.evaluation.study.observations import Observation, Outcome, Sweep
from app.progress import Progress, named, part


def study(monkeypatch: pytest.MonkeyPatch, *words: str) -> int:
    """Run `svwfs study` and return its status."""
    monkeypatch.setattr(sys, "argv", ["svwfs", "study", *words])
    with pytest.raises(SystemExit) as leaving:
        main()
    return int(leaving.value.code or 0)


def at(curve: list[dict[str, Any]], position: float | str) -> dict[str, Any]:
    return next(point for point in curve if point["at"] == position)


def test_what_is_written(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, small_toml: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ("--seeds", "1", "--bench", str(small_toml), "--out", str(tmp_path))
    assert study(monkeypatch, "dead", "dead", *words) == 0
    written = json.loads((tmp_path / "study.json").read_text())
    assert written["seeds"] == 1
    assert list(written["sweeps"]) == ["dead"]
    dead = written["sweeps"]["dead"]
    assert dead["axis"] == "part of all lenslets"
    curves = dead["curves"]
    assert set(curves) >= {"affine", "quadratic", "cubic", "cubic refined", "cubic refined, at the dead ones"}
    none, some = at(curves["cubic refined"], 0.0), at(curves["cubic refined"], 0.2)
    assert (none["lost_lenslets"], some["lost_lenslets"]) == (0, 7)  # of 35
    assert (none["observations"], none["spread_rad"]) == (1, 0)
    assert none["mean_rad"] < 0.8 * at(curves["cubic"], 0.0)["mean_rad"]
    with (tmp_path / "study.csv").open() as file:
        rows = {(row["sweep"], row["curve"], row["at"]): row for row in csv.DictReader(file)}
    assert float(rows["dead", "cubic refined", "0.2"]["mean_rad"]) == some["mean_rad"]
    assert_drawn(tmp_path / "estimator.png")
    printed = capsys.readouterr().out
    assert "Dead lenslets: residual RMS (rad)" in printed
    assert f"{some['mean_rad']:.3f} x7" in printed


def test_an_unknown_sweep_is_refused_before_anything_is_computed(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert study(monkeypatch, "sise", "--out", str(tmp_path / "new")) == 2
    said = capsys.readouterr().err
    assert said.startswith("svwfs: no sweep is called sise; there are ensembles, ")
    assert said.count("\n") == 1
    assert not (tmp_path / "new").exists()


def _one(_bench: Bench, seeds: int, _progress: Progress) -> Iterator[Observation]:
    yield from (Observation(curve="affine", at="here", rms_rad=0.1 * seed, lost=seed) for seed in range(seeds))


def _interrupted(*_: object) -> Iterator[Observation]:
    yield Observation(curve="affine", at=1.0, rms_rad=0.1)
    os.kill(os.getpid(), signal.SIGINT)
    yield Observation(curve="affine", at=2.0, rms_rad=0.1)


def test_interrupting_leaves_the_sweeps_that_are_finished(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    one, other = (Sweep(name=run.__name__, title="", axis="", run=run) for run in (_one, _interrupted))
    monkeypatch.setattr(sweeps, "SWEEPS", {"one": one, "other": other})
    assert study(monkeypatch, "--out", str(tmp_path)) == 130
    assert capsys.readouterr().err.strip().endswith(f"interrupted: 1 of 2 sweeps are in {tmp_path}")
    assert list(json.loads((tmp_path / "study.json").read_text())["sweeps"]) == ["_one"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["estimator.png", "study.csv", "study.json"]


def test_points_are_mean_and_spread_of_what_has_a_result() -> None:
    sweep = Sweep(name="", title="", axis="", run=_one, asked_rad={"affine": {"here": 0.3}})
    seen = [Observation(curve="affine", at="here", rms_rad=rms, lost=lost) for rms, lost in ((1.0, 0), (2.0, 3))]
    nothing = Observation(curve="affine", at="here", rms_rad=math.nan, lost=9)
    point = Outcome(sweep, (*seen, nothing)).points("affine")["here"]
    assert (point.mean_rad, point.observations, point.lost_lenslets, point.asked_rad) == (1.5, 2, 4.0, 0.3)
    assert point.spread_rad == pytest.approx(math.sqrt(0.5))


def test_only_known_lenslets_and_views_count() -> None:
    difference = np.zeros((1, 2, 2, 2))
    difference[0, 0] = [[1.0, 3.0], [50.0, 1.0]]
    lenslets = np.array([[True, True], [False, False]])
    assert mean_rms(difference, lenslets) == 0.5  # of 1 and 0
    assert mean_rms(difference, lenslets, np.array([[True, False]])) == 1.0
    assert math.isnan(mean_rms(difference, np.zeros((2, 2), np.bool_)))


def test_what_was_computed_is_remembered_until_it_is_damaged_or_old(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []

    def compute() -> dict[str, Any]:
        calls.append(1)
        return {"value": np.array(len(calls))}

    folder = cache_folder() / "test-kind"
    assert [int(remembered("test-kind", "a", compute)["value"]) for _ in range(2)] == [1, 1]
    (folder / "a.npz").write_bytes(b"PK nonsense")
    assert int(remembered("test-kind", "a", compute)["value"]) == 2
    monkeypatch.setattr(app.cache, "_KEPT", 1)
    os.utime(folder / "a.npz", (0, 0))
    remembered("test-kind", "b", compute)
    assert [path.name for path in folder.glob("*")] == ["b.npz"]


def test_noise_free_frames_are_what_the_bench_casts_on_its_camera(small_toml: Path) -> None:
    bench = load_bench(small_toml)
    frames = NoiseFreeFrames(bench)
    frame, again = frames.frame("square"), NoiseFreeFrames(bench).frame("square")
    assert np.array_equal(frame.photons, again.photons)
    assert np.array_equal(frame.truth, again.truth)
    assert frame.truth.shape == (3, 3, 5, 7)
    assert frames.reference("square").sum() == pytest.approx(frame.photons.sum(), rel=0.01)


@pytest.mark.parametrize(("em_gain", "light_e"), [(1.0, 900.0), (30.0, 100.0)])
def test_the_cameras_noise_is_the_one_that_the_estimator_is_told(
    small_toml: Path, em_gain: float, light_e: float
) -> None:
    seen = camera(load_bench(small_toml), 3, em_gain)
    electrons = np.full((200, 300), light_e, np.float32)
    counts = seen.exposed(electrons, seed=5, index=0)
    assert counts.mean() == pytest.approx(seen.counts(electrons).mean(), rel=0.01)
    assert counts.var() == pytest.approx(seen.noise.variance(seen.counts(electrons)).mean(), rel=0.03)


def test_progress_of_parts() -> None:
    heard: list[tuple[str, float]] = []
    named(part(lambda text, done: heard.append((text, done)), 1, 4), "sweep")("step", 0.5)
    assert heard == [("sweep: step", 0.375)]
