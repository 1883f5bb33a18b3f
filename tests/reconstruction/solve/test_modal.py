"""Modal reconstruction against dense generalised least squares, ridge regression and the scatter of many draws."""

from __future__ import annotations

import numpy as np
import pytest
from support.optics import sensor_of

from reconstruction.arrays import Floats
from reconstruction.displacement import diagonal_covariance
from reconstruction.errors import ReconstructionError
from reconstruction.modes.pupil_modes import pupil_modes
from reconstruction.solve.modal import ModalSolver
from reconstruction.solve.weights import Whitening, no_whitening, whitening

ROWS, COLUMNS, FIELD_MODES = 7, 8, 3
SENSOR = sensor_of(ROWS, COLUMNS)
MODES = pupil_modes(SENSOR, "legendre", 15)
ALL = np.ones((ROWS, COLUMNS), np.bool_)
GRADIENTS = MODES.gradients[1:].reshape(14, -1).T  # (lenslet x xy, pupil_mode - 1)


def hanging_together(generator: np.random.Generator) -> Floats:
    """Covariance of field modes, correlated differently along x and y: (field_mode, xy, ...)."""
    covariance = np.zeros((FIELD_MODES, 2, FIELD_MODES, 2))
    for axis in (0, 1):
        root = generator.normal(size=(FIELD_MODES, FIELD_MODES))
        covariance[:, axis, :, axis] = root @ root.T + 0.1 * np.eye(FIELD_MODES)
    return covariance


def of_unit_noise(covariance: Floats) -> Whitening:
    """Whitening without the systematic error."""
    return whitening(covariance * 1e6)


def made_of(coefficients: Floats) -> Floats:
    """Slopes (lenslet_row, lenslet_column, field_mode, xy) of coefficients (pupil_mode, field_mode)."""
    return np.asarray(np.einsum("prcx,pq->rcqx", MODES.gradients, coefficients))


def test_weighted_combinations_match_generalised_least_squares() -> None:
    generator = np.random.default_rng(1)
    shared = hanging_together(generator)
    strength = generator.uniform(0.2, 5, ALL.shape)  # of each lenslet's noise, as a variance
    covariance = strength[..., None, None, None, None] * shared
    slopes = generator.normal(size=(ROWS, COLUMNS, FIELD_MODES, 2))
    valid = ALL.copy()
    valid[2, 3] = valid[5, 0] = False
    slopes[~valid] = np.nan
    solver = ModalSolver(MODES, of_unit_noise(shared), is_smooth=False)
    solution = solver(slopes, covariance, valid, weights=1 / strength)

    gradients = MODES.gradients[1:, valid]  # (p, lenslet, xy)
    design = np.einsum("pla,qr->laqpr", gradients, np.eye(FIELD_MODES)).reshape(valid.sum(), 2, FIELD_MODES, -1)
    normal, right = 0.0, 0.0
    for one, noise, data in zip(design, covariance[valid], slopes[valid], strict=True):
        rows = one.reshape(2 * FIELD_MODES, -1)  # ordered (xy, field_mode)
        inverse = np.linalg.inv(noise.transpose(1, 0, 3, 2).reshape(2 * FIELD_MODES, -1))
        normal, right = normal + rows.T @ inverse @ rows, right + rows.T @ inverse @ data.T.ravel()
    expected = np.linalg.solve(normal, right).reshape(14, FIELD_MODES)
    np.testing.assert_allclose(solution.coefficients[1:], expected, rtol=1e-5, atol=1e-12)
    variance = np.diag(np.linalg.inv(normal)).reshape(14, FIELD_MODES)
    np.testing.assert_allclose(solution.coefficients_sigma[1:], np.sqrt(variance), rtol=1e-5)


def test_prior_is_ridge_regression_chosen_by_evidence() -> None:
    generator = np.random.default_rng(2)
    scale = MODES.degree[1:] ** -5.0
    truth = np.zeros((15, 1))
    truth[1:, 0] = 3000 * scale * generator.normal(size=14)
    noise = 40.0
    slopes = made_of(truth) + generator.normal(0, noise, (ROWS, COLUMNS, 1, 2))
    covariance = np.broadcast_to(diagonal_covariance(np.full((1, 2), noise**2)), (ROWS, COLUMNS, 1, 2, 1, 2))
    solution = ModalSolver(MODES, no_whitening(1), is_smooth=True)(slopes, covariance, ALL)

    data = slopes[:, :, 0].ravel()

    def evidence(prior: float, level: float) -> float:
        spread = level**2 * np.eye(data.size) + prior**2 * (GRADIENTS * scale**2) @ GRADIENTS.T
        return float(-np.linalg.slogdet(spread)[1] / 2 - data @ np.linalg.solve(spread, data) / 2)

    grid = [(prior, level) for prior in np.geomspace(300, 30000, 25) for level in np.geomspace(20, 80, 25)]
    prior, level = max(grid, key=lambda both: evidence(*both))
    ridge = GRADIENTS.T @ GRADIENTS + np.diag((level / prior / scale) ** 2)
    expected = np.linalg.solve(ridge, GRADIENTS.T @ data)
    np.testing.assert_allclose(solution.coefficients[1:, 0], expected, atol=0.1 * noise * 1e-3)


def test_noisy_modes_are_suppressed_and_lost_lenslet_is_bridged() -> None:
    generator = np.random.default_rng(3)
    many = pupil_modes(SENSOR, "legendre", None)
    truth = np.zeros((many.degree.size, 1))
    truth[1:6, 0] = [4, -3, 2, 1, -2]
    slopes = np.einsum("prcx,pq->rcqx", many.gradients, truth) + generator.normal(0, 300, (ROWS, COLUMNS, 1, 2))
    covariance = np.broadcast_to(diagonal_covariance(np.full((1, 2), 300.0**2)), (ROWS, COLUMNS, 1, 2, 1, 2))
    valid = ALL.copy()
    valid[3, 3] = False
    slopes[3, 3] = np.nan
    expected = np.tensordot(truth[:, 0], many.values, axes=1)
    expected -= expected.mean()

    smooth = ModalSolver(many, no_whitening(1), is_smooth=True)(slopes, covariance, valid)
    wavefront, sigma = smooth.wavefront(np.ones(1)), smooth.sigma(np.ones(1))
    assert np.isfinite(wavefront).all()
    assert np.isfinite(sigma).all()
    rough = ModalSolver(many, no_whitening(1), is_smooth=False)(slopes, covariance, valid).wavefront(np.ones(1))
    assert np.isnan(rough[3, 3])
    assert np.sqrt(np.mean((wavefront - expected) ** 2)) < 0.6 * np.sqrt(np.nanmean((rough - expected) ** 2))
    assert abs(wavefront[3, 3] - expected[3, 3]) < 3 * sigma[3, 3]
    corner = valid.copy()
    corner[:3, :3] = False
    beyond = ModalSolver(many, no_whitening(1), is_smooth=True)(slopes, covariance, corner)
    assert np.isnan(beyond.wavefront(np.ones(1))[0, 0])  # two lenslets from the next that is known
    assert beyond.sigma(np.ones(1))[2, 0] > 2 * beyond.sigma(np.ones(1))[3, 5]


@pytest.mark.parametrize("is_smooth", [False, True])
def test_scatter_of_wavefronts_matches_sigma(is_smooth: bool) -> None:
    generator = np.random.default_rng(4)
    shared = hanging_together(generator) * 100.0
    root = np.linalg.cholesky(shared.reshape(2 * FIELD_MODES, -1))
    truth = generator.normal(size=(15, FIELD_MODES)) * np.r_[0, MODES.degree[1:] ** -2.0][:, None]
    exact = made_of(truth)
    solver = ModalSolver(MODES, of_unit_noise(shared), is_smooth=is_smooth)
    covariance = np.broadcast_to(shared, (ROWS, COLUMNS, *shared.shape))
    view = np.array([1.0, -0.4, 0.7])

    def draw() -> tuple[Floats, Floats, float]:
        noise = (generator.normal(size=(ROWS, COLUMNS, 2 * FIELD_MODES)) @ root.T).reshape(exact.shape)
        solution = solver(exact + noise, covariance, ALL)
        return solution.wavefront(view), solution.sigma(view), solution.chi_square

    wavefronts, sigmas, chi_squares = (np.array(values) for values in zip(*(draw() for _ in range(300)), strict=True))
    expected = np.tensordot(truth @ view, MODES.values, axes=1)
    error = wavefronts - (expected - expected.mean())
    ratio = np.sqrt(np.mean(error**2, axis=0)) / np.mean(sigmas, axis=0)
    assert 0.93 < np.sqrt(np.mean(ratio**2)) < 1.07
    assert 0.9 < np.mean(chi_squares) < 1.1


def test_too_few_lenslets_are_refused_only_without_prior() -> None:
    few = np.zeros_like(ALL)
    few[0, :3] = True
    slopes = np.ones((ROWS, COLUMNS, 1, 2))
    covariance = np.broadcast_to(np.eye(2).reshape(1, 2, 1, 2), (ROWS, COLUMNS, 1, 2, 1, 2))
    with pytest.raises(ReconstructionError, match="3 valid lenslets cannot tell 15 pupil modes apart"):
        ModalSolver(MODES, no_whitening(1), is_smooth=False)(slopes, covariance, few)
    bridged = ModalSolver(MODES, no_whitening(1), is_smooth=True)(slopes, covariance, few).wavefront(np.ones(1))
    assert np.isfinite(bridged[few]).all()


def test_zero_slopes_give_flat_wavefront() -> None:
    covariance = np.zeros((ROWS, COLUMNS, 1, 2, 1, 2))
    solution = ModalSolver(MODES, no_whitening(1), is_smooth=True)(np.zeros((ROWS, COLUMNS, 1, 2)), covariance, ALL)
    np.testing.assert_allclose(solution.wavefront(np.ones(1)), 0, atol=1e-12)
