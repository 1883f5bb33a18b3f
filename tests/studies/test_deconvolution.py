"""Corrected images against the truth: photographs in propagated light, by code that the estimator does not share."""

from __future__ import annotations

import pytest

import svwfs
from studies.deconvolution import deconvolution
from studies.tables import Asked


@pytest.mark.slow
@pytest.mark.long
def test_measured_psfs_are_far_better_than_one_and_as_good_as_the_true_ones() -> None:
    bench = svwfs.load_bench("paper_simulation", "simulation.source.mask='checkerboard'")
    psnr_db = deconvolution(Asked(bench))[0].set_index("object")
    assert set(psnr_db.index) == {"target", "cells", "stars"}
    assert (psnr_db["measured PSFs"] > psnr_db["best single PSF"] + 3).all()
    assert (psnr_db["measured PSFs"] > psnr_db["photograph"] + 3).all()
    assert (psnr_db["measured PSFs"] > psnr_db["true PSFs"] - 0.5).all()
