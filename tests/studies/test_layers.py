"""Correctors as predicted from one frame, against light through sample and corrector; distances of a layer."""

from __future__ import annotations

import pytest

from app.bench.config import load_bench
from reconstruction.layers.corrector import Corrector
from studies.layers import distances, predicted_and_simulated
from studies.tables import Asked

LAYER_M = 0.195
BENCH = load_bench("small_demo", ("simulation.source.mask='checkerboard'",))


@pytest.mark.slow
def test_predicted_residuals_agree_with_simulated_ones() -> None:
    cases = [(Corrector("zernike", 10), share * LAYER_M) for share in (0.0, 1.0)]
    found = list(predicted_and_simulated(BENCH, cases))
    predicted, simulated = ([each["rms_rad"] for each in found[start::2]] for start in (0, 1))
    assert [each["at"] for each in found[::2]] == [at_m * 1e3 for _, at_m in cases]
    assert simulated == pytest.approx(predicted, rel=0.1)
    assert simulated[1] < 0.4 * simulated[0]


@pytest.mark.slow
def test_distances_of_a_layer_are_found_within_their_error_bars() -> None:
    table, _ = distances(Asked(BENCH), (LAYER_M,))
    found = table.set_index("case")
    assert list(found.index) == ["checkerboard, 195 mm", "square, 195 mm"]
    assert (found["error (%), worst"] < 20).all()
    assert (found["error over its bar, worst"] < 4).all()
