"""Residual of a corrector as predicted from one frame, against frames rendered through sample and corrector."""

from __future__ import annotations

import pytest

from app.bench.config import load_bench
from app.evaluation.study.corrector import predicted_and_simulated
from reconstruction.layers.corrector import Corrector

LAYER_M = 0.195


def test_predicted_residuals_agree_with_simulated_ones() -> None:
    cases = [(Corrector("zernike", 10), share * LAYER_M) for share in (0.0, 0.5, 1.0)]
    found = list(predicted_and_simulated(load_bench("small_demo"), cases, lambda *_: None))
    predicted, simulated = ([float(each.values["rms_rad"]) for each in found[start::2]] for start in (0, 1))
    assert [each.at["at"] for each in found[::2]] == [at_m for _, at_m in cases]
    assert simulated == pytest.approx(predicted, rel=0.1)
    assert simulated[2] < 0.4 * simulated[0]
