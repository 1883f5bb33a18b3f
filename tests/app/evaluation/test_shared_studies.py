"""Studies whose seeds are tasks of their own: the same results as in one go."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from support.batches import one_by_one

from app.bench.config import Bench, load_bench
from app.errors import InputError
from app.evaluation.frames import seeded
from app.evaluation.studies import CaseResult, Study, run_studies
from app.evaluation.study import sweeps
from app.evaluation.study.sweeps import PHOTONS
from app.evaluation.study.trials import calibration_trials
from app.evaluation.study_kinds import Sweep
from app.progress import Progress


def _made_up(bench: Bench, seeds: range, _progress: Progress) -> Iterator[CaseResult]:
    for screen in seeded(bench, seeds):
        for at in (2.0, 1.0):
            values = {"rms_rad": screen.simulation.seed * at, "lost": 0, "left_cell": 0}
            yield CaseResult(at={"curve": "only", "at": at}, values=values)


def made_up(name: str) -> Sweep:
    return Sweep(name=name, title="", axis="", measure=_made_up)


def without_times(data: pd.DataFrame) -> pd.DataFrame:
    return data.drop(columns=["CPU time (s)"], errors="ignore")


@pytest.mark.parametrize(
    "study",
    [made_up("made"), pytest.param(PHOTONS, marks=[pytest.mark.slow, pytest.mark.long]), calibration_trials()],
    ids=lambda study: study.name,
)
def test_shared_seeds_give_the_same_results(
    study: Study, small_toml: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sweeps, "_PEAKS_E", (1e3,))
    monkeypatch.setattr(sweeps, "_NOISE_DRAWS", 2)
    bench = load_bench(small_toml)
    (whole,) = run_studies([study], bench, seeds=2, out=tmp_path / "whole", progress=lambda *_: None)
    (shared,) = run_studies(
        [study], bench, seeds=2, out=tmp_path / "shared", progress=lambda *_: None, evaluate=one_by_one
    )
    pd.testing.assert_frame_equal(without_times(shared.data), without_times(whole.data), check_exact=True)
    assert shared.data.groupby([*study.dims], observed=True).size().max() >= 2


def test_studies_keep_their_order_whichever_ends_first(small_toml: Path, tmp_path: Path) -> None:
    def backwards(function: Any, items: Any) -> Iterator[Any]:
        yield from reversed(list(one_by_one(function, items)))

    studies = [made_up("first"), made_up("second")]
    bench = load_bench(small_toml)
    results = run_studies(studies, bench, seeds=3, out=tmp_path, progress=lambda *_: None, evaluate=backwards)
    assert [result.study.name for result in results] == ["first", "second"]
    seeds = [screen.simulation.seed for screen in seeded(bench, range(3))]
    data = results[0].data
    assert data.loc[data["at"] == 2.0, "rms_rad"].tolist() == [2.0 * seed for seed in seeds]


def test_failure_of_a_seed_is_that_of_the_study(small_toml: Path, tmp_path: Path) -> None:
    def fail(*_: object) -> Iterator[CaseResult]:
        raise InputError("no view lies inside it")

    study = Sweep(name="failing", title="", axis="", measure=fail)
    with pytest.raises(InputError, match="no view lies inside it"):
        run_studies(
            [study], load_bench(small_toml), seeds=2, out=tmp_path, progress=lambda *_: None, evaluate=one_by_one
        )
