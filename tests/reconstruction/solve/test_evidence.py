"""Quality of fits, free and of layers, against SciPy's multivariate normal distribution."""

from __future__ import annotations

import numpy as np
import pytest
import scipy  # which loads its parts when they are used
from support.optics import FIELD, converged, sensor_of

from reconstruction.arrays import Floats
from reconstruction.displacement import SYSTEMATIC_PX, diagonal_covariance
from reconstruction.layers.layer_solver import FrameEquations, LayerSolver, prior_scale
from reconstruction.modes.field_modes import LegendreModes, gradient_basis
from reconstruction.modes.layered_modes import layered_wavefronts
from reconstruction.modes.pupil_modes import pupil_modes
from reconstruction.solve.evidence import Estimate, FitQuality
from reconstruction.solve.expected_errors import ExpectedErrors, MeanGradients
from reconstruction.solve.modal import ModalSolver

SENSOR, MODES, FIELD_MODES = sensor_of(3, 4), pupil_modes(sensor_of(3, 4), "legendre", 6), LegendreModes(3)
GRADIENTS = gradient_basis(FIELD_MODES)
SIGMA_PX = 0.05
PRIOR = (MODES.degree[1:, None] + FIELD_MODES.degree) ** -5.0 * 0.5**FIELD_MODES.degree


def check(found: FitQuality, design: Floats, data: Floats) -> None:
    """Compare with N(0, noise (1 + ratio A A^T)), A the `design` in units of the prior, at the best of all ratios.

    The evidence has no 2 pi; ratios are tried in steps of a quarter of a decade of the largest eigenvalue.
    """
    largest = np.linalg.norm(design, 2) ** 2

    def evidence(ratio: float) -> float:
        spread = np.eye(data.size) + ratio * design @ design.T
        noise = max(float(data @ np.linalg.solve(spread, data)) / data.size, 1.0)
        return float(
            scipy.stats.multivariate_normal(cov=noise * spread).logpdf(data) + data.size * np.log(2 * np.pi) / 2
        )

    tried = 10.0 ** np.arange(-4, 7, 0.25) / largest
    ratio = float(tried[np.argmax([evidence(each) for each in tried])])
    assert found.log_evidence == pytest.approx(evidence(ratio), abs=1e-3)
    hat = ratio * design @ np.linalg.inv(np.eye(design.shape[1]) + ratio * design.T @ design) @ design.T
    left = np.sum((data - hat @ data) ** 2)
    assert found.chi_square == pytest.approx(left / (data.size - np.trace(hat)), rel=1e-3)
    assert found.misfit == pytest.approx(np.sqrt(left / (data @ data)), rel=1e-3)


@pytest.mark.parametrize("noise", [1.0, 3.0])
def test_quality_is_the_gaussian_evidence(noise: float) -> None:
    generator = np.random.default_rng(4)
    rad = 3 * PRIOR * generator.normal(size=PRIOR.shape)
    gradients = MODES.gradients[1:] / SENSOR.slope_per_px  # px per rad, (pupil_mode - 1, row, column, xy)
    px = np.einsum("prcx,pq->rcqx", gradients, rad)
    px += generator.normal(0, noise * SIGMA_PX, px.shape)
    displacement = converged(FIELD_MODES, px, np.full(px.shape, SIGMA_PX**2))
    layered = layered_wavefronts(SENSOR, MODES, FIELD_MODES, GRADIENTS)
    solver = ModalSolver(
        MODES,
        MeanGradients(SENSOR, GRADIENTS),
        GRADIENTS,
        diagonal_covariance(np.full(px.shape, SIGMA_PX**2)),
        layered=layered,
        field_degree=FIELD_MODES.degree,
    )
    sigma_px = np.hypot(SIGMA_PX, SYSTEMATIC_PX)
    data = np.swapaxes(px, 2, 3).reshape(-1, 6) @ GRADIENTS.T / sigma_px
    to_modes = GRADIENTS.reshape(-1, 2, 3)  # (K, xy, field_mode)
    of_modes = np.einsum("prcx,kxq->rckpq", gradients, to_modes).reshape(data.size, -1) / sigma_px
    assert layered is not None
    check(solver.quality(displacement), (of_modes * PRIOR.ravel()) @ layered(PRIOR), data.ravel())

    layers = LayerSolver(SENSOR, FIELD, FIELD_MODES, solver, hidden=0)
    rows = np.concatenate([layers.rows(ratio, layers.degree) for ratio in (-0.4, -1.2)], axis=2)
    design = rows.reshape(data.size, -1) * np.tile(prior_scale(layers.degree), 2)
    check(FrameEquations(layers, displacement).fit(-0.4, -1.2).quality, design, data.ravel())


def test_displacements_that_fit_exactly_leave_no_error() -> None:
    """Those of a frame without noise that only moved: there was no variance to divide by."""
    everywhere = np.ones((3, 4), np.bool_)
    covariance = diagonal_covariance(np.full((3, 4, 3, 2), SIGMA_PX**2))
    errors = ExpectedErrors(MeanGradients(SENSOR, GRADIENTS), GRADIENTS, covariance, everywhere)
    exact = Estimate(values=np.zeros(2), ratio=1e3, noise=0.0, freedom=10.0)
    np.testing.assert_array_equal(errors.variance(exact, np.array([2.0, 0.0]), 4.0), [0, 0])
