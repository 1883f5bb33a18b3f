"""Trials of routines: calibration and auto-exposure."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from support.paths import FOREIGN_FRAMES

from app.bench.config import load_bench
from drivers.interface import Range
from studies.calibration import calibration
from studies.exposure import EIGHT, IMAGES, TriedCamera, exposure
from studies.tables import Asked

SQUARES = {"squares": IMAGES["squares"]}


def test_calibration_meets_its_limits(small_toml: Path) -> None:
    table = calibration(Asked(load_bench(small_toml), frames=FOREIGN_FRAMES))[0].set_index("case")
    assert {case.rpartition(", ")[2] for case in table.index} == {"clean", "faint"}
    assert {"square_reference.tif, clean", "random lattices, stars, faint"} <= set(table.index)
    assert (table["refusals"] == "").all()
    limits = {"centre (px)": 0.1, "pitch (px)": 0.02, "rotation (mrad)": 0.2, "lit, wrong": 0}
    for name, most in limits.items():
        assert (table[f"{name}, worst"] <= np.where(table.index.str.endswith("faint"), 2 * most, most)).all(), name


@pytest.mark.slow
def test_exposure_meets_its_limits_or_reports_the_problem(small_toml: Path) -> None:
    asked = Asked(load_bench(small_toml))
    table: pd.DataFrame = exposure(asked, [TriedCamera("8 bits", Range(1e-5, 7200.0), EIGHT)], SQUARES)[0]
    assert table["trials"].tolist() == table["as_asked"].tolist() == [63, 63, 63]
    dark = {**EIGHT, "well_counts": 100.0}
    table = exposure(asked, [TriedCamera("full", Range(0.01, 1.0), dark)], SQUARES)[0]
    assert (table["as_asked"] < table["trials"]).all()
    assert table["refusals"].str.contains("do not follow").all()
