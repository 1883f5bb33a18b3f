"""Corrected images against the truth: photographs rendered by code that the estimator does not share."""

from __future__ import annotations

from pathlib import Path

import pytest
import xarray as xr

import svwfs
from app.evaluation.cases import collect
from app.evaluation.study.deconvolution import DECONVOLUTION
from app.evaluation.study_files import files_of, write_newest
from app.evaluation.study_kinds import StudyResult
from app.evaluation.study_tables import print_results

pytestmark = pytest.mark.soak


@pytest.fixture(scope="module")
def data() -> xr.Dataset:
    bench = svwfs.load_bench("paper_simulation")
    return collect(DECONVOLUTION.dims, DECONVOLUTION.measure(bench, range(1), lambda *_: None))


@pytest.mark.parametrize("name", ["target", "cells", "stars"])
def test_measured_psfs_are_far_better_than_one_and_as_good_as_the_true_ones(data: xr.Dataset, name: str) -> None:
    psnr_db = {way: data["psnr_db"].sel(object=name, way=way).item() for way in data["way"].values.tolist()}
    assert psnr_db["measured PSFs"] > psnr_db["best single PSF"] + 3
    assert psnr_db["measured PSFs"] > psnr_db["photograph"] + 3
    assert psnr_db["measured PSFs"] > psnr_db["true PSFs"] - 0.5


def test_study_writes_its_files(data: xr.Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    result = StudyResult(DECONVOLUTION, data, 1)
    write_newest([result], tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {path.name for path in files_of([DECONVOLUTION], tmp_path)}
    print_results([result])
    assert "best single PSF" in capsys.readouterr().out
