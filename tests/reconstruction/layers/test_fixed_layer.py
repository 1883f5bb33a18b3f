"""One layer at a fixed distance, prepared once, against the fit that forms the normal equations of every frame."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.polynomial import polynomial as powers
from support.polynomial_layers import PHASE, displacement, displacements_px, noisy, solver

from reconstruction.arrays import Floats
from reconstruction.errors import ReconstructionError
from reconstruction.layers.layer_fit import LayerFit

SOLVER = solver()
LENSLETS = displacements_px(PHASE, 0.0).shape[:2]


def check_same(found: LayerFit, full: LayerFit, tolerance: float) -> None:
    (layer,), (expected,) = found.layers, full.layers
    assert layer.ratio == expected.ratio
    x_m, y_m = (np.linspace(-half_m, half_m, 17) for half_m in expected.half_width_m)
    for values, true in (
        (layer.phase(x_m, y_m[:, None]), expected.phase(x_m, y_m[:, None])),
        (layer.sigma(x_m, y_m[:, None]), expected.sigma(x_m, y_m[:, None])),
    ):
        np.testing.assert_allclose(values, true, rtol=0, atol=tolerance * np.abs(true).max())
    for name in ("log_evidence", "chi_square", "misfit"):
        assert getattr(found, name) == pytest.approx(getattr(full, name), rel=10 * tolerance), name


@pytest.mark.parametrize("ratio", [0.0, 0.975, 6.0])
def test_fixed_distance_equals_the_full_fit(ratio: float) -> None:
    measured = displacement(noisy(displacements_px(PHASE, 0.975), 1))
    check_same(SOLVER.at(ratio)(measured), SOLVER(measured).fit(ratio), 1e-9)


@pytest.mark.parametrize("lost", [1, 20, 50])
def test_lost_lenslets_are_down_dated(lost: int) -> None:
    measured = displacement(noisy(displacements_px(PHASE, 0.975), 2), lost=lost)
    check_same(SOLVER.at(0.975)(measured), SOLVER(measured).fit(0.975), 1e-7)


def test_faint_lenslets_count_less() -> None:
    measured = displacement(noisy(displacements_px(PHASE / 10, 0.975), 3))
    weights = np.where(np.arange(np.prod(LENSLETS)) % 3, 1.0, 1 / 16).reshape(LENSLETS)
    found = SOLVER.at(0.975)(measured, weights)
    check_same(found, SOLVER(measured, weights).fit(0.975), 1e-7)
    assert (found.layers[0].sigma(*CENTRE) > 1.1 * SOLVER.at(0.975)(measured).layers[0].sigma(*CENTRE)).all()


CENTRE: tuple[Floats, Floats] = (np.linspace(-1e-3, 1e-3, 5), np.zeros(5))


def test_phase_is_that_of_the_layer() -> None:
    (layer,) = SOLVER.at(0.6)(displacement(displacements_px(PHASE, 0.6), lost=3)).layers
    x_m, y_m = (np.linspace(-half_m, half_m, 21) * 0.8 for half_m in layer.half_width_m)
    true = powers.polygrid2d(y_m * 1e3, x_m * 1e3, PHASE)
    assert np.std(layer.phase(x_m, y_m[:, None]) - true) < 2e-3 * np.std(true)


def test_too_few_lenslets_are_refused() -> None:
    few = displacement(displacements_px(PHASE, 0.6), lost=int(np.prod(LENSLETS)) - 8)
    with pytest.raises(ReconstructionError, match="at least 9 valid lenslets"):
        SOLVER.at(0.6)(few)
