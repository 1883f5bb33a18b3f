"""Wavefronts over layers, prepared once, against the fit that forms the normal equations of every frame."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.polynomial import polynomial as powers
from support.polynomial_layers import FIELD, MODES, OTHER, PHASE, SENSOR, displacement, displacements_px, noisy, solver

from reconstruction.arrays import Floats
from reconstruction.errors import ReconstructionError
from reconstruction.layers.layer_modes import LayerModes
from reconstruction.layers.layered_wavefront import AssumedSample, LayeredWavefronts
from reconstruction.modes.field_modes import gradient_basis
from reconstruction.solve.modal_solution import ModalSolution

SOLVER = solver()
WAVEFRONTS = LayeredWavefronts(SOLVER, LayerModes(SOLVER.degree, SENSOR, FIELD, MODES), gradient_basis(MODES))
LENSLETS = displacements_px(PHASE, 0.0).shape[:2]
AT = (0.3e-3, -0.5e-3)
ONE, TWO = AssumedSample((-0.975,)), AssumedSample((-1.6, -0.4))
OF_TWO = displacements_px(3 * PHASE, -0.4) + displacements_px(3 * OTHER, -1.6)


def at(solution: ModalSolution) -> Floats:
    return solution.wavefront(MODES.values(*np.array(AT) / FIELD.half_width_m))


@pytest.mark.parametrize("lost", [0, 1, 20])
@pytest.mark.parametrize(("sample", "clean"), [(ONE, displacements_px(PHASE, -0.975)), (TWO, OF_TWO)])
def test_prepared_solve_equals_the_full_fit(sample: AssumedSample, clean: Floats, lost: int) -> None:
    measured = displacement(noisy(clean, 1), lost=lost)
    found, full = WAVEFRONTS(measured, None, sample), SOLVER(measured).fit(*sample.ratios)
    expected = full.wavefront(SENSOR, *AT)
    difference = (at(found) - expected)[found.known]
    assert np.std(difference) < 1e-3 * np.std(expected)
    explained = SOLVER(measured).explained(full)
    px = np.matvec(SOLVER.errors.colour, explained) @ gradient_basis(MODES)
    expected_px = np.swapaxes(px.reshape(*LENSLETS, 2, -1), 2, 3)
    np.testing.assert_allclose(found.displacement, expected_px, atol=2e-4 * np.abs(expected_px).max())


def test_wavefront_is_that_of_the_layer() -> None:
    found = WAVEFRONTS(displacement(displacements_px(PHASE, -0.6), lost=3), None, AssumedSample((-0.6,)))
    u_mm, v_mm = SENSOR.pupil_x_m * 1e3, SENSOR.pupil_y_m * 1e3
    true = powers.polygrid2d(v_mm - 0.6 * AT[1] * 1e3, u_mm - 0.6 * AT[0] * 1e3, PHASE)
    difference = (at(found) - true)[found.known]
    assert np.std(difference) < 3e-3 * np.std(true)


def test_faint_lenslets_count_less() -> None:
    measured = displacement(noisy(displacements_px(PHASE / 10, -0.975), 3))
    weights = np.where(np.arange(np.prod(LENSLETS)) % 3, 1.0, 1 / 16).reshape(LENSLETS)
    found = WAVEFRONTS(measured, weights, ONE)
    expected = SOLVER(measured, weights).fit(*ONE.ratios).wavefront(SENSOR, *AT)
    assert np.std(at(found) - expected) < 1e-3 * np.std(expected)
    values = MODES.values(0.0, 0.0)
    assert found.sigma(values).mean() > 1.1 * WAVEFRONTS(measured, None, ONE).sigma(values).mean()


def test_error_bars_include_those_of_the_distance() -> None:
    measured = displacement(noisy(displacements_px(20 * PHASE, -0.975), 1))
    uncertain = AssumedSample(ONE.ratios, np.array([[0.02**2]]))
    values = MODES.values(*np.array(AT) / FIELD.half_width_m)
    total, of_noise = (WAVEFRONTS(measured, None, sample).sigma(values) for sample in (uncertain, ONE))
    near, far = (at(WAVEFRONTS(measured, None, AssumedSample((-0.975 + step,)))) for step in (-0.01, 0.01))
    assert np.sqrt(np.mean(total**2 - of_noise**2)) == pytest.approx(np.std(far - near), rel=0.05)


def test_too_few_lenslets_are_refused() -> None:
    few = displacement(displacements_px(PHASE, -0.6), lost=int(np.prod(LENSLETS)) - 8)
    with pytest.raises(ReconstructionError, match="at least 9 valid lenslets"):
        WAVEFRONTS(few, None, ONE)
