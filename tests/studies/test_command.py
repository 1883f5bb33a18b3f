"""`python -m studies`: its list, its files, its refusals; tables that studies share."""

from __future__ import annotations

import math
from pathlib import Path

import pandas as pd
import pytest
from support.pictures import assert_drawn

from studies import __main__ as command
from studies.tables import Asked, Made, curves, draw_curves, trial, trials


def made_up(asked: Asked) -> Made:
    """Nothing."""
    rows = [
        {"curve": "affine", "at": at, "rms_rad": rms_rad, "lost": lost}
        for at, rms_rad, lost in ((1.0, 1.0, 0), (1.0, 2.0, 3), (1.0, math.nan, 9), (2.0, float(len(asked.seeds)), 0))
    ]
    table = curves(rows)
    return table, draw_curves(table, "Made up", "at")


def test_study_is_written_and_printed(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, small_toml: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(command.STUDIES, "made_up", made_up)
    command.main(["made_up", "--seeds", "4", "--bench", str(small_toml), "--out", str(tmp_path)])
    here, there = pd.read_csv(tmp_path / "made_up.csv").to_dict("records")
    assert (here["mean_rad"], here["observations"], here["lost"]) == (1.5, 2, 4.0)
    assert here["spread_rad"] == pytest.approx(math.sqrt(0.5))
    assert (there["mean_rad"], there["observations"], there["spread_rad"]) == (4.0, 1, 0.0)
    assert_drawn(tmp_path / "made_up.png")
    assert "affine  1.5    4" in capsys.readouterr().out


def test_help_lists_every_study_with_a_sentence(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        command.main(["--help"])
    lines = capsys.readouterr().out.split("studies:\n")[1].splitlines()
    assert [line.split()[0] for line in lines] == list(command.STUDIES)
    assert all(len(line.split()) > 4 for line in lines)


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ("size --set lattice.arrangement=hexagonal --bench small_demo", "made for square lattices"),
        ("mask nothing.png", "there is no mask and no file nothing.png"),
        ("mask checkerboard:101", "mask checkerboard:101: simulation.source.checker_cells must be 2 ... 100"),
        ("masks .", "the folder . holds no picture of a mask"),
        ("calibration --frames .", "holds no *_reference.tif"),
        ("size --bench nothing.toml", "nothing.toml"),
    ],
)
def test_unusable_input_is_one_sentence(
    words: str, sentence: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit, match="studies: ") as leaving:
        command.main(words.split())
    assert sentence in str(leaving.value.code)


def test_trial_is_as_asked_within_all_limits() -> None:
    rows = [
        trial("one", {"a": a, "b": b}, {"a": 2.0}, "no" * math.isnan(a))
        for a, b in ((2.0, 9.0), (2.1, 0.0), (math.nan, 0))
    ]
    table, figure = trials(rows, "Made up")
    (row,) = table.to_dict("records")
    assert (row["case"], row["trials"], row["as_asked"], row["refusals"]) == ("one", 3, 1, "no")
    assert (row["a, median"], row["a, worst"], row["b, worst"]) == (2.05, 2.1, 9.0)
    assert len(figure.axes) == 2
