"""Trials of `svwfs study`: limits, files, calibration and auto-exposure."""

from __future__ import annotations

import csv
import itertools
import json
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from support.command_line import run
from support.paths import FOREIGN_FRAMES

from app.bench.config import Bench, load_bench
from app.evaluation import study
from app.evaluation.studies import CaseResult, collect
from app.evaluation.study import trials as module
from app.evaluation.study.trials import calibration_trials
from app.evaluation.study_kinds import TrialStudy, trial
from app.progress import Progress
from drivers.interface import Range
from reconstruction.geometry import Lattice
from reconstruction.lattice.search import Survey, survey


def made(case: str, **measured: float) -> CaseResult:
    problem = "no" if any(math.isnan(value) for value in measured.values()) else ""
    return trial(case=case, name="", measured=measured, limits=dict.fromkeys(measured, 2.0), problem=problem)


def measure(_bench: Bench, seeds: range, _progress: Progress) -> Iterator[CaseResult]:
    yield from (made("one", a=float(value), b=0.5) for value in range(1, len(seeds) + 1))
    yield made("other", a=math.nan, b=math.nan)


STUDY = TrialStudy(name="made", title="Made up", measure=measure)


def trials_of(study: TrialStudy, small_toml: Path) -> tuple[pd.DataFrame, pd.DataFrame]:
    data = collect(study.dims, study.measure(load_bench(small_toml), range(1), lambda *_: None))
    return data, study.trials(data)


def test_trial_is_as_asked_within_all_limits() -> None:
    results = [made("", a=2.0, b=0.0), made("", a=2.1, b=0.0), made("", a=1.0, b=math.nan)]
    trials = STUDY.trials(collect(STUDY.dims, results))
    assert trials["as_asked"].tolist() == [True, False, False]


def test_trials_are_written_and_printed(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(study, "EXPOSURE", STUDY)
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


def test_calibration_meets_its_limits(small_toml: Path) -> None:
    data, trials = trials_of(calibration_trials(FOREIGN_FRAMES), small_toml)
    cases = data["case"].tolist()
    assert cases == trials["case"].tolist()  # one each
    assert {case.rpartition(", ")[2] for case in cases} == {"clean", "faint"}
    assert {"square_reference.tif, clean", "random lattices, stars, faint"} <= set(cases)
    assert not trials["refusal"].any()
    timeless = data.drop(columns=["CPU time (s)", "CPU time (s), limit"])
    assert TrialStudy.trials(timeless)["as_asked"].all()
    limits = data[data["case"] == "random lattices, square, faint"].iloc[0]
    assert [limits[f"{name}, limit"] for name in ("centre (px)", "pitch (px)", "rotation (mrad)")] == [0.2, 0.04, 0.4]


def test_calibration_rejects_a_folder_without_frames(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, small_toml: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ("--frames", tmp_path, "--bench", small_toml, "--out", tmp_path / "out")
    assert run(monkeypatch, "study", "calibration", *arguments) == 2
    assert f"{tmp_path}: holds no *_reference.tif" in capsys.readouterr().err
    assert run(monkeypatch, "study", "exposure", *arguments) == 2
    assert "--frames is only for the calibration study" in capsys.readouterr().err


def test_calibration_measures_wrong_results(monkeypatch: pytest.MonkeyPatch, small_toml: Path) -> None:
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

    monkeypatch.setattr(module, "survey", wrong)
    results = calibration_trials().measure(load_bench(small_toml), range(1), lambda *_: None)
    first = TrialStudy.trials(collect(TrialStudy.dims, itertools.islice(results, 1))).iloc[0]
    expected = {
        "centre (px)": 5.0,
        "pitch (px)": 0.25,
        "rotation (mrad)": 1.0,
        "whole, wrong by": 1.0,
        "lit, wrong": 2.0,
    }
    assert {name: first[name] for name in expected} == pytest.approx(expected, abs=0.01)
    assert not first["as_asked"]


@pytest.mark.slow
def test_exposure_meets_its_limits_or_reports_the_problem(monkeypatch: pytest.MonkeyPatch, small_toml: Path) -> None:
    camera = module._Camera("8 bits", Range(1e-5, 7200.0), module._EIGHT)
    monkeypatch.setattr(module, "_CAMERAS", (camera,))
    monkeypatch.setattr(module, "_IMAGES", {"squares": module._IMAGES["squares"]})
    _, trials = trials_of(module.EXPOSURE, small_toml)
    assert len(trials) == 3 * module._STARTS * module._RIGHT
    assert trials["as_asked"].all()
    assert set(trials["frames"]) >= {1, 3, 4}
    monkeypatch.setattr(module, "_RIGHT", 1)
    dark = {**module._EIGHT, "well_counts": 100.0}
    monkeypatch.setattr(module, "_CAMERAS", (module._Camera("full", Range(0.01, 1.0), dark),))
    _, trials = trials_of(module.EXPOSURE, small_toml)
    first = trials.iloc[0]
    assert not first["as_asked"]
    assert "do not follow" in str(first["refusal"])
