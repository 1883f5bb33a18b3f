"""Sweeps of `svwfs study`: files, summaries, interruption, and the frames they are made from."""

from __future__ import annotations

import csv
import json
import math
import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.command_line import run
from support.pictures import assert_drawn

import app.cache
from app.bench.config import Bench, load_bench
from app.cache import cache_folder, cached
from app.evaluation import study
from app.evaluation.frames import NoiseFreeFrames
from app.evaluation.studies import CaseResult, collect, known_rows
from app.evaluation.study.estimators import camera, mean_rms_within
from app.evaluation.study_kinds import Sweep
from app.progress import Progress, named, part


def at(curve: list[dict[str, Any]], position: float | str) -> dict[str, Any]:
    return next(point for point in curve if point["at"] == position)


@pytest.mark.slow
@pytest.mark.long
def test_sweeps_are_written_and_printed(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, small_toml: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ("--seeds", "1", "--bench", str(small_toml), "--out", str(tmp_path))
    assert run(monkeypatch, "study", "dead", "dead", *words) == 0
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
    assert none["mean_rad"] < at(curves["cubic"], 0.0)["mean_rad"]
    with (tmp_path / "study.csv").open() as file:
        rows = {(row["sweep"], row["curve"], row["at"]): row for row in csv.DictReader(file)}
    assert float(rows["dead", "cubic refined", "0.2"]["mean_rad"]) == some["mean_rad"]
    assert_drawn(tmp_path / "estimator.png")
    printed = capsys.readouterr().out
    assert "Dead lenslets: residual RMS (rad)" in printed
    assert f"{some['mean_rad']:.3f} x7" in printed


def test_unknown_sweep_is_rejected_before_computing(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, "study", "sise", "--out", str(tmp_path / "new")) == 2
    said = capsys.readouterr().err
    assert said.startswith("svwfs: no sweep is called sise; there are ensembles, ")
    assert said.count("\n") == 1
    assert not (tmp_path / "new").exists()


def sampled(rms_rad: float, *, at: float | str = "here", lost: int = 0) -> CaseResult:
    values = {"rms_rad": rms_rad, "lost": lost, "left_cell": 0}
    return CaseResult(at={"curve": "affine", "at": at}, values=values)


def _finished(_bench: Bench, seeds: range, _progress: Progress) -> Iterator[CaseResult]:
    yield from (sampled(0.1 * seed, lost=seed) for seed in seeds)


def _interrupted(*_: object) -> Iterator[CaseResult]:
    yield sampled(0.1, at=1.0)
    os.kill(os.getpid(), signal.SIGINT)
    yield sampled(0.1, at=2.0)


def test_interrupt_keeps_finished_sweeps(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sweeps = tuple(Sweep(name=each.__name__, title="", axis="", measure=each) for each in (_finished, _interrupted))
    monkeypatch.setattr(study, "SWEEPS", sweeps)
    assert run(monkeypatch, "study", "--out", str(tmp_path)) == 130
    assert capsys.readouterr().err.strip().endswith(f"interrupted: 1 of 2 studies are in {tmp_path}")
    assert list(json.loads((tmp_path / "study.json").read_text())["sweeps"]) == ["_finished"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["estimator.png", "study.csv", "study.json"]


def test_summary_is_mean_and_spread_of_known_results() -> None:
    sweep = Sweep(name="", title="", axis="", measure=_finished, limits_rad={"affine": {"here": 0.3}})
    results = [sampled(1.0), sampled(2.0, lost=3), sampled(math.nan, lost=9), sampled(4.0, at="there")]
    here, there = known_rows(sweep.summary(collect(sweep.dims, results)))
    assert (here["mean_rad"], here["observations"], here["lost_lenslets"], here["asked_rad"]) == (1.5, 2, 4.0, 0.3)
    assert here["spread_rad"] == pytest.approx(math.sqrt(0.5))
    assert (there["mean_rad"], there["observations"], there["spread_rad"]) == (4.0, 1, 0.0)
    assert "asked_rad" not in there


def test_collect_sorts_results_by_positions_as_they_first_occur() -> None:
    found = (("a", 2.0, 1), ("b", 1.0, 2), ("a", 1.0, math.nan), ("a", 2.0, 3))
    results = [CaseResult(at={"curve": curve, "at": at}, values={"x": x}) for curve, at, x in found]
    data = collect(("curve", "at"), results)
    assert known_rows(data[["curve", "at", "x"]]) == [
        {"curve": "a", "at": 2.0, "x": 1},
        {"curve": "a", "at": 2.0, "x": 3},
        {"curve": "a", "at": 1.0},
        {"curve": "b", "at": 1.0, "x": 2},
    ]


def test_mean_rms_ignores_unknown_lenslets_and_views() -> None:
    difference = np.zeros((1, 2, 2, 2))
    difference[0, 0] = [[1.0, 3.0], [50.0, 1.0]]
    lenslets = np.array([[True, True], [False, False]])
    assert mean_rms_within(difference, lenslets) == 0.5  # of 1 and 0
    assert mean_rms_within(difference, lenslets, np.array([[True, False]])) == 1.0
    assert math.isnan(mean_rms_within(difference, np.zeros((2, 2), np.bool_)))


def test_cache_recomputes_damaged_and_drops_old_results(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []

    def compute() -> dict[str, Any]:
        calls.append(1)
        return {"value": np.array(len(calls))}

    folder = cache_folder() / "test-kind"
    assert [int(cached("test-kind", "a", compute)["value"]) for _ in range(2)] == [1, 1]
    (folder / "a.npz").write_bytes(b"PK nonsense")
    assert int(cached("test-kind", "a", compute)["value"]) == 2
    monkeypatch.setattr(app.cache, "_KEPT", 1)
    os.utime(folder / "a.npz", (0, 0))
    cached("test-kind", "b", compute)
    assert [path.name for path in folder.glob("*")] == ["b.npz"]


def test_noise_free_frames_are_reproducible_and_conserve_light(small_toml: Path) -> None:
    bench = load_bench(small_toml, ("field.neglect_propagation=true",))  # else light leaves and enters the lattice
    frames = NoiseFreeFrames(bench)
    frame, again = frames.frame("square"), NoiseFreeFrames(bench).frame("square")
    assert np.array_equal(frame.photons, again.photons)
    assert np.array_equal(frame.truth, again.truth)
    assert frame.truth.shape == (3, 3, 5, 7)
    assert frames.reference("square").sum() == pytest.approx(frame.photons.sum(), rel=0.01)


@pytest.mark.parametrize(("em_gain", "light_e"), [(1.0, 900.0), (30.0, 100.0)])
def test_camera_noise_matches_noise_model(small_toml: Path, em_gain: float, light_e: float) -> None:
    seen = camera(load_bench(small_toml), 3, em_gain)
    electrons = np.full((200, 300), light_e, np.float32)
    counts = seen.exposed(electrons, seed=5, index=0)
    assert counts.mean() == pytest.approx(seen.counts(electrons).mean(), rel=0.01)
    assert counts.var() == pytest.approx(seen.noise.variance(seen.counts(electrons)).mean(), rel=0.03)


def test_named_part_scales_progress() -> None:
    heard: list[tuple[str, float]] = []
    named(part(lambda text, done: heard.append((text, done)), 1, 4), "sweep")("step", 0.5)
    assert heard == [("sweep: step", 0.375)]
