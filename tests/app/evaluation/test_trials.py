"""The studies of calibration and auto-exposure: what they ask, what they write, and that they can fail."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.command_line import run

from app.bench.config import Bench, load_bench
from app.evaluation.study import calibration, exposure, sweeps
from app.evaluation.study.trials import Trial, TrialOutcome, TrialStudy
from app.progress import Progress
from drivers.interface import Range
from reconstruction.geometry import Lattice
from reconstruction.lattice.search import Survey, survey


def trial(case: str, **figures: float) -> Trial:
    refused = {"refusal": "no"} if any(math.isnan(value) for value in figures.values()) else {}
    return Trial(case=case, name="", figures=figures, asked=dict.fromkeys(figures, 2.0), **refused)


def made(_bench: Bench, seeds: int, _progress: Progress) -> Iterator[Trial]:
    yield from (trial("one", a=float(value), b=0.5) for value in range(1, seeds + 1))
    yield trial("other", a=math.nan, b=math.nan)


def test_a_trial_holds_when_all_that_is_asked_is_reached() -> None:
    assert trial("", a=2.0, b=0.0).holds
    assert not trial("", a=2.1, b=0.0).holds
    assert not trial("", a=1.0, b=math.nan).holds


def test_what_is_written_and_printed(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    study = TrialStudy(name="made", title="Made up", run=made)
    monkeypatch.setattr(sweeps, "TRIALS", {"made": study})
    assert run(monkeypatch, "study", "made", "--seeds", "5", "--out", tmp_path) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["made.csv", "made.json", "made.png"]
    written = json.loads((tmp_path / "made.json").read_text())["cases"]
    assert written["one"] == {
        "trials": 5,
        "as_asked": 2,
        "refusals": [],
        "a": {"median": 3.0, "worst": 5.0, "asked": 2.0},
        "b": {"median": 0.5, "worst": 0.5, "asked": 2.0},
    }
    assert (written["other"]["as_asked"], written["other"]["refusals"], written["other"]["a"]) == (
        0,
        ["no"],
        {"asked": 2.0},
    )
    with (tmp_path / "made.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["a"] for row in rows] == ["1.0", "2.0", "3.0", "4.0", "5.0", ""]
    printed = capsys.readouterr().out
    assert "2 of 5   3 / 5 (2)" in printed
    assert "other, : no" in printed


def test_calibration_knows_the_truth_of_every_frame(small_toml: Path) -> None:
    trials = list(calibration.CALIBRATION.run(load_bench(small_toml), 1, lambda *_: None))
    outcome = TrialOutcome(calibration.CALIBRATION, tuple(trials))
    assert len(outcome.cases) == len(trials)  # one each
    assert {case.rpartition(", ")[2] for case in outcome.cases} == {"clean", "faint"}
    assert {"HCIPy's square_reference.tif, clean", "random lattices, stars, faint"} <= set(outcome.cases)
    for each in trials:
        assert not each.refusal
        others = {name: value for name, value in each.figures.items() if name != "CPU time (s)"}
        assert replace(each, figures=others, asked={name: each.asked[name] for name in others}).holds
    asked = trials[outcome.cases.index("random lattices, square, faint")].asked
    assert (asked["centre (px)"], asked["pitch (px)"], asked["rotation (mrad)"]) == (0.2, 0.04, 0.4)


def test_calibration_sees_what_is_wrong(monkeypatch: pytest.MonkeyPatch, small_toml: Path) -> None:
    right = survey

    def wrong(light: np.ndarray[tuple[int, ...], np.dtype[np.float32]], *others: object) -> Survey:
        found = right(light, *others)  # type: ignore[arg-type] # the sensor
        lit = found.illuminated.copy()
        lit[0, :2] ^= True
        moved = Lattice(
            center_x_px=found.lattice.center_x_px + 3,
            center_y_px=found.lattice.center_y_px - 4,
            pitch_px=found.lattice.pitch_px + 0.25,
            rotation_rad=found.lattice.rotation_rad + 0.001,
        )
        return replace(found, lattice=moved, rows=found.rows + 1, illuminated=lit)

    monkeypatch.setattr(calibration, "survey", wrong)
    monkeypatch.setattr(calibration, "_FOREIGN", ())
    first = next(calibration.CALIBRATION.run(load_bench(small_toml), 1, lambda *_: None))
    expected = {
        "centre (px)": 5.0,
        "pitch (px)": 0.25,
        "rotation (mrad)": 1.0,
        "whole, wrong by": 1.0,
        "lit, wrong": 2.0,
    }
    assert {name: first.figures[name] for name in expected} == pytest.approx(expected, abs=0.01)
    assert not first.holds


def test_exposure_counts_frames_and_looks_at_the_light(monkeypatch: pytest.MonkeyPatch, small_toml: Path) -> None:
    camera = exposure._Camera("8 bits", Range(1e-5, 7200.0), exposure._EIGHT)
    monkeypatch.setattr(exposure, "_CAMERAS", (camera,))
    monkeypatch.setattr(exposure, "_IMAGES", {"squares": exposure._IMAGES["squares"]})
    trials = list(exposure.EXPOSURE.run(load_bench(small_toml), 1, lambda *_: None))
    assert len(trials) == 3 * exposure._STARTS * exposure._RIGHT
    assert all(each.holds for each in trials)
    assert {each.figures["frames"] for each in trials} >= {1, 3, 4}
    monkeypatch.setattr(exposure, "_RIGHT", 1)
    dark = {**exposure._EIGHT, "well_counts": 100.0}
    monkeypatch.setattr(exposure, "_CAMERAS", (exposure._Camera("full", Range(0.01, 1.0), dark),))
    (first, *_) = exposure.EXPOSURE.run(load_bench(small_toml), 1, lambda *_: None)
    assert not first.holds
    assert "do not follow" in first.refusal
