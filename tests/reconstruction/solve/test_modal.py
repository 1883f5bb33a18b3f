"""Modal reconstruction against dense generalised least squares, ridge regression and the scatter of many draws."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from support.optics import sensor_of

from reconstruction.arrays import Booleans, Floats
from reconstruction.displacement import SYSTEMATIC_PX, Displacement, LensletStatus, diagonal_covariance
from reconstruction.errors import ReconstructionError
from reconstruction.modes.field_modes import LegendreModes, gradient_basis
from reconstruction.modes.layered_modes import layered_basis
from reconstruction.modes.pupil_modes import PupilModes, pupil_modes
from reconstruction.solve.expected_errors import MeanGradients
from reconstruction.solve.modal import ModalSolver

ROWS, COLUMNS, FIELD_MODES = 7, 8, 3
SENSOR = sensor_of(ROWS, COLUMNS)
MODES = pupil_modes(SENSOR, "legendre", 15)
FIELD = LegendreModes(FIELD_MODES)
ALL = np.ones((ROWS, COLUMNS), np.bool_)
EVERYTHING = np.eye(2 * FIELD_MODES)  # every displacement is a parameter
GRADIENTS = gradient_basis(FIELD)  # all but the rotation
SIGNAL = 1000.0  # that the prior expects at least in the displacements, over the variance of their noise
VIEW = np.array([1.0, -0.4, 0.7])
PRIOR = (MODES.degree[1:, None] + FIELD.degree) ** -5.0 * 0.5**FIELD.degree  # (pupil_mode - 1, field_mode)


def correlated(generator: np.random.Generator, sigma_px: float = 0.05) -> Floats:
    """Covariance of each lenslet's displacements, x correlated with y: (row, column, field_mode, xy, ...), px^2."""
    root = generator.normal(size=(ROWS, COLUMNS, 2 * FIELD_MODES, 2 * FIELD_MODES))
    covariance = (root @ np.swapaxes(root, 2, 3) / (2 * FIELD_MODES) + 0.1 * np.eye(2 * FIELD_MODES)) * sigma_px**2
    return np.asarray(covariance.reshape(ROWS, COLUMNS, FIELD_MODES, 2, FIELD_MODES, 2))


def noise_of(covariance: Floats, generator: np.random.Generator) -> Floats:
    """One draw of displacements with that covariance and the systematic error, px."""
    size = 2 * covariance.shape[2]
    full = covariance.reshape(ROWS, COLUMNS, size, size) + SYSTEMATIC_PX**2 * np.eye(size)
    drawn = np.matvec(np.linalg.cholesky(full), generator.normal(size=(ROWS, COLUMNS, size)))
    return np.asarray(drawn.reshape(ROWS, COLUMNS, -1, 2))


def made_of(coefficients: Floats, modes: PupilModes = MODES) -> Floats:
    """Displacements (row, column, field_mode, xy), px, of coefficients (pupil_mode, field_mode)."""
    return np.asarray(np.einsum("prcx,pq->rcqx", modes.gradients, coefficients) / SENSOR.slope_per_px)


def measured(coefficients: Floats, covariance: Floats, valid: Booleans = ALL) -> Displacement:
    outcome = np.where(valid, LensletStatus.CONVERGED, LensletStatus.DIVERGED).astype(np.int8)
    coefficients = np.where(valid[..., None, None], coefficients, np.nan)
    covariance = np.where(valid[..., None, None, None, None], covariance, np.nan)
    modes = LegendreModes(coefficients.shape[2])
    return Displacement(modes, coefficients, covariance, outcome, *np.zeros((3, ROWS, COLUMNS)))


def solver_of(
    covariance: Floats, *, is_smooth: bool = False, parameters: Floats = EVERYTHING, modes: PupilModes = MODES
) -> ModalSolver:
    """Solver with mean gradients; of layered wavefronts, if the parameters show no rotation."""
    field = LegendreModes(parameters.shape[1] // 2)
    layered = partial(layered_basis, modes.products[1:], field.products, half_width=np.array(SENSOR.pupil_half_width_m))
    return ModalSolver(
        modes,
        MeanGradients(SENSOR, parameters),
        parameters,
        covariance,
        layered=layered if len(parameters) < parameters.shape[1] else None,
        field_degree=field.degree if is_smooth else None,
    )


def whitened(covariance: Floats, px: Floats, parameters: Floats = EVERYTHING) -> tuple[Floats, Floats]:
    """Design matrix (lenslet, K, (pupil_mode - 1) * field_mode) and data (lenslet, K) of unit noise."""
    to_modes = parameters.reshape(-1, 2, FIELD_MODES).transpose(0, 2, 1)  # (K, field_mode, xy)
    gradients = MODES.gradients[1:].reshape(14, -1, 2) / SENSOR.slope_per_px
    design = np.einsum("pla,kqa->lkpq", gradients, to_modes).reshape(ROWS * COLUMNS, len(parameters), -1)
    data = np.einsum("lqa,kqa->lk", px.reshape(-1, FIELD_MODES, 2), to_modes)
    noise = np.einsum("kqa,lqarb,jrb->lkj", to_modes, covariance.reshape(-1, *covariance.shape[2:]), to_modes)
    root = np.linalg.inv(np.linalg.cholesky(noise))
    return root @ design, np.matvec(root, data)


def enlarged(level: float) -> float:
    """Variance of the errors, in units of the noise: what chance does not explain is alike in three lenslets."""
    return level + 2 * max(level - 1.2, 0.0)


@pytest.mark.parametrize("parameters", [EVERYTHING, GRADIENTS], ids=["rotation", "layered"])
def test_full_covariance_and_weights_match_generalised_least_squares(parameters: Floats) -> None:
    generator = np.random.default_rng(1)
    covariance, px = correlated(generator), generator.normal(size=(ROWS, COLUMNS, FIELD_MODES, 2))
    valid = ALL.copy()
    valid[2, 3] = valid[5, 0] = False
    weights = generator.choice([1.0, 0.25, 1 / 16], ALL.shape)
    solver = solver_of(covariance, parameters=parameters)
    solution = solver(measured(px, covariance, valid), weights=weights)

    design, data = whitened(covariance, px, parameters)
    root = np.sqrt(np.where(valid, weights, 0.0).ravel())
    design = (root[:, None, None] * design).reshape(-1, design.shape[2])
    allowed = np.eye(design.shape[1])
    if parameters is GRADIENTS:  # the polynomials (x d/du + y d/dv)^m Phi(u, v), by their equations at many places
        allowed = np.linalg.svd(_rotations())[2][-(2 + 3 + 4 + 5 + 3 + 4 + 5 + 6) :].T
    normal = allowed.T @ design.T @ design @ allowed
    expected = allowed @ np.linalg.solve(normal, allowed.T @ design.T @ (root[:, None] * data).ravel())
    np.testing.assert_allclose(solution.coefficients[1:].ravel(), expected, atol=2e-4 * np.abs(expected).max())
    # What the modes leave shows errors that the noise does not explain: these displacements belong to no wavefront.
    left = (root[:, None] * data).ravel() - design @ expected
    level = left @ left / (np.count_nonzero(root) * data.shape[1] - allowed.shape[1])
    assert level > 100
    of_coefficients = enlarged(level) * allowed @ np.linalg.inv(normal) @ allowed.T
    root = solution.root_covariance.reshape(14 * FIELD_MODES, -1).astype(np.float64)
    found = root @ root.T
    np.testing.assert_allclose(found, of_coefficients, atol=1e-3 * np.abs(of_coefficients).max())
    np.testing.assert_allclose(
        solution.coefficients_sigma[1:].ravel(),
        np.sqrt(np.diag(of_coefficients)),
        rtol=1e-2,
        atol=1e-4 * np.sqrt(level),
    )


def _rotations() -> Floats:
    """(d_u d_y - d_v d_x) R_p T_q at many places, (place, (pupil_mode - 1) * field_mode), from finite differences."""
    half_x, half_y = SENSOR.pupil_half_width_m
    unit = LegendreModes(15)
    u, v = np.random.default_rng(0).uniform(-1, 1, (2, 200))
    x, y = np.random.default_rng(1).uniform(-1, 1, (2, 200))
    step = 1e-5
    slope_u = (unit.values(u + step, v) - unit.values(u - step, v))[1:] / (2 * step) / half_x
    slope_v = (unit.values(u, v + step) - unit.values(u, v - step))[1:] / (2 * step) / half_y
    slope_x = (FIELD.values(x + step, y) - FIELD.values(x - step, y)) / (2 * step)
    slope_y = (FIELD.values(x, y + step) - FIELD.values(x, y - step)) / (2 * step)
    rotations = np.einsum("pi,qi->ipq", slope_u, slope_y) - np.einsum("pi,qi->ipq", slope_v, slope_x)
    return np.asarray(rotations.reshape(200, -1))


@pytest.mark.slow
@pytest.mark.parametrize("noise", [3.0, 0.1])
def test_prior_is_ridge_regression_chosen_by_evidence(noise: float) -> None:
    generator = np.random.default_rng(2)
    scale = PRIOR.ravel()
    truth = np.zeros((15, FIELD_MODES))
    truth[1:] = (20 * scale * generator.normal(size=14 * FIELD_MODES)).reshape(14, -1)
    covariance = correlated(generator)
    px = made_of(truth) + noise * noise_of(covariance, generator)
    solution = solver_of(covariance, is_smooth=True)(measured(px, covariance))

    design, data = whitened(covariance, px)
    design, data = design.reshape(data.size, -1) * scale, data.ravel()
    normal, right = design.T @ design, design.T @ data

    def evidence(ratio: float, variance: float) -> float:  # of data with the covariance variance (1 + ratio A A^T)
        inner = np.eye(len(normal)) + ratio * normal
        square = (data @ data - ratio * right @ np.linalg.solve(inner, right)) / variance
        return float(-(np.linalg.slogdet(inner)[1] + data.size * np.log(variance) + square) / 2)

    levels = np.geomspace(1, 25, 100)  # the data are no more certain than their covariance says
    grid = [(ratio, level) for ratio in np.geomspace(1e-1, 1e5, 121) for level in levels]
    ratio, level = max(grid, key=lambda both: evidence(*both))
    assert (level == 1.0) == (noise < 1)
    ratio = max(ratio, SIGNAL * data.size / np.trace(normal))
    expected = ratio * np.linalg.solve(np.eye(len(normal)) + ratio * normal, right)
    larger = enlarged(level) / level
    sigma = np.sqrt(level * np.diag(np.linalg.inv(normal / larger + np.eye(len(normal)) / ratio)))
    # The ratio is found to a quarter of a decade.
    np.testing.assert_allclose(solution.coefficients[1:].ravel() / scale, expected, atol=0.2 * sigma.max())
    np.testing.assert_allclose(solution.coefficients_sigma[1:].ravel() / scale, sigma, rtol=0.25)
    last = np.argsort(scale)[-10:]  # determined by the data
    np.testing.assert_allclose((solution.coefficients_sigma[1:].ravel() / scale)[last], sigma[last], rtol=0.1)


@pytest.mark.parametrize("is_smooth", [False, True])
@pytest.mark.parametrize("parameters", [EVERYTHING, GRADIENTS], ids=["rotation", "layered"])
def test_down_dated_equations_equal_those_prepared_so(is_smooth: bool, parameters: Floats) -> None:
    generator = np.random.default_rng(5)
    covariance = correlated(generator)
    weights = generator.choice([0.0, 0.25, 1.0], ALL.shape, p=[0.1, 0.4, 0.5])
    assert {0.0, 0.25, 1.0} == set(weights.flat)
    smooth = np.r_[0, MODES.degree[1:] ** -3.0][:, None] * generator.normal(size=(15, FIELD_MODES))
    px = made_of(smooth) + noise_of(covariance, generator)
    found = solver_of(covariance, is_smooth=is_smooth, parameters=parameters)(measured(px, covariance), weights=weights)
    less_certain = covariance / np.where(weights > 0, weights, np.nan)[..., None, None, None, None]
    fresh = solver_of(less_certain, is_smooth=is_smooth, parameters=parameters)(measured(px, covariance))

    np.testing.assert_allclose(found.coefficients, fresh.coefficients, atol=2e-4 * np.abs(fresh.coefficients).max())
    np.testing.assert_array_equal(np.isfinite(found.wavefront(VIEW)), np.isfinite(fresh.wavefront(VIEW)))
    np.testing.assert_allclose(found.wavefront(VIEW), fresh.wavefront(VIEW), atol=1e-3)
    np.testing.assert_allclose(found.sigma(VIEW), fresh.sigma(VIEW), rtol=3e-3)


def test_noisy_modes_are_suppressed_and_lost_lenslet_is_bridged() -> None:
    generator = np.random.default_rng(3)
    many = pupil_modes(SENSOR, "legendre", None)
    truth = np.zeros((many.degree.size, 1))
    truth[1:6, 0] = [4, -3, 2, 1, -2]
    variance = np.full((ROWS, COLUMNS, 1, 2), (300.0 / SENSOR.slope_per_px) ** 2)
    covariance = diagonal_covariance(variance)
    px = made_of(truth, many) + generator.normal(0, np.sqrt(variance))
    valid = ALL.copy()
    valid[3, 3] = False
    expected = np.tensordot(truth[:, 0], many.values, axes=1)
    expected -= expected.mean()

    smooth_solver = solver_of(covariance, is_smooth=True, modes=many, parameters=np.eye(2))
    smooth = smooth_solver(measured(px, covariance, valid))
    wavefront, sigma = smooth.wavefront(np.ones(1)), smooth.sigma(np.ones(1))
    assert np.isfinite(wavefront).all()
    assert np.isfinite(sigma).all()
    rough_solver = solver_of(covariance, modes=many, parameters=np.eye(2))
    rough = rough_solver(measured(px, covariance, valid)).wavefront(np.ones(1))
    assert np.isnan(rough[3, 3])
    assert np.sqrt(np.mean((wavefront - expected) ** 2)) < 0.6 * np.sqrt(np.nanmean((rough - expected) ** 2))
    assert abs(wavefront[3, 3] - expected[3, 3]) < 3 * sigma[3, 3]
    corner = valid.copy()
    corner[:3, :3] = False
    beyond = smooth_solver(measured(px, covariance, corner))
    assert np.isnan(beyond.wavefront(np.ones(1))[0, 0])  # two lenslets from the next that is known
    assert beyond.sigma(np.ones(1))[2, 0] > 2 * beyond.sigma(np.ones(1))[3, 5]
    cross = ALL.copy()
    cross[2:5, 3] = cross[3, 2:5] = False  # its middle has known neighbours only along the diagonals
    assert np.isfinite(smooth_solver(measured(px, covariance, cross)).wavefront(np.ones(1))).all()


@pytest.mark.parametrize("is_smooth", [False, True])
def test_scatter_of_wavefronts_matches_sigma(is_smooth: bool) -> None:
    generator = np.random.default_rng(4)
    covariance = correlated(generator)
    scale = np.concatenate([np.zeros((1, FIELD_MODES)), PRIOR])
    solver = solver_of(covariance, is_smooth=is_smooth)
    design, data = whitened(covariance, np.zeros((ROWS, COLUMNS, FIELD_MODES, 2)))
    strength = np.sqrt(1.2 * SIGNAL * data.size / np.sum((design * PRIOR.ravel()) ** 2))  # a little above the least
    errors, sigmas, of_coefficients, chi_squares, misfits = [], [], [], [], []
    for _ in range(200):
        truth = strength * scale * generator.normal(size=scale.shape)  # the prior's wavefronts
        px = made_of(truth) + noise_of(covariance, generator)
        solution = solver(measured(px, covariance))
        expected = np.tensordot(truth @ VIEW, MODES.values, axes=1)
        errors.append(solution.wavefront(VIEW) - (expected - expected.mean()))
        sigmas.append(solution.sigma(VIEW))
        of_coefficients.append((solution.coefficients - truth)[1:] / solution.coefficients_sigma[1:])
        chi_squares.append(solution.chi_square)
        misfits.append(solution.misfit - (px - made_of(solution.coefficients)))
    ratio = np.array(errors) / np.array(sigmas)
    assert np.sqrt(np.mean(ratio**2)) == pytest.approx(1, abs=0.06)
    assert np.mean(np.abs(ratio) < 1) == pytest.approx(0.683, abs=0.03)
    assert np.mean(np.abs(of_coefficients) < 1) == pytest.approx(0.683, abs=0.03)
    # Misfits are compared with marginal variances; correlated, they have other degrees of freedom than counted.
    assert np.mean(chi_squares) == pytest.approx(1, abs=0.1)
    np.testing.assert_allclose(misfits, 0, atol=1e-4)


def test_misfit_without_rotation_keeps_the_rotation() -> None:
    generator = np.random.default_rng(6)
    covariance = correlated(generator)
    unseen = np.linalg.svd(GRADIENTS)[2][-1].reshape(2, FIELD_MODES).T  # (field_mode, xy)
    rotation = np.broadcast_to(unseen, (ROWS, COLUMNS, FIELD_MODES, 2))
    solution = solver_of(covariance, parameters=GRADIENTS)(measured(rotation, covariance))
    np.testing.assert_allclose(solution.coefficients, 0, atol=1e-6)
    np.testing.assert_allclose(solution.misfit, rotation, atol=1e-6)


@pytest.mark.parametrize("parameters", [EVERYTHING, GRADIENTS], ids=["rotation", "layered"])
def test_mean_gradients_of_coefficients_are_solved_back(parameters: Floats) -> None:
    generator = np.random.default_rng(7)
    truth = np.zeros((15, FIELD_MODES))
    truth[1:] = generator.normal(size=(14, FIELD_MODES))
    if parameters is GRADIENTS:
        basis = layered_basis(
            MODES.products[1:], FIELD.products, np.ones((14, FIELD_MODES)), np.array(SENSOR.pupil_half_width_m)
        )
        truth[1:] = (basis @ (basis.T @ truth[1:].ravel())).reshape(14, FIELD_MODES)
    covariance = correlated(generator)
    solution = solver_of(covariance, parameters=parameters)(measured(made_of(truth), covariance))
    np.testing.assert_allclose(solution.coefficients, truth, atol=1e-4)
    np.testing.assert_allclose(solution.misfit, 0, atol=1e-5)


def test_unknown_noise_is_a_systematic_misfit() -> None:
    generator = np.random.default_rng(8)
    unknown = np.zeros((ROWS, COLUMNS, FIELD_MODES, 2, FIELD_MODES, 2))
    sigma_px = 0.04
    noise = generator.normal(0, sigma_px, (ROWS, COLUMNS, FIELD_MODES, 2))
    solution = solver_of(unknown)(measured(noise, unknown))
    design, _ = whitened(diagonal_covariance(np.full_like(noise, sigma_px**2)), noise)
    design = design.reshape(-1, design.shape[2])
    expected = 2 * np.sqrt(np.diag(np.linalg.inv(design.T @ design)))  # systematic errors are alike in four lenslets
    np.testing.assert_allclose(solution.coefficients_sigma[1:].ravel(), expected, rtol=0.15)


def test_rotation_is_refused_where_it_is_not_seen() -> None:
    covariance = np.zeros((ROWS, COLUMNS, FIELD_MODES, 2, FIELD_MODES, 2))
    with pytest.raises(ReconstructionError, match="56 valid lenslets cannot determine 15 pupil modes"):
        ModalSolver(MODES, MeanGradients(SENSOR, GRADIENTS), GRADIENTS, covariance)


def test_too_few_lenslets_are_refused_only_without_prior() -> None:
    few = np.zeros_like(ALL)
    few[0, :3] = True
    covariance = np.broadcast_to(np.eye(2).reshape(1, 2, 1, 2) * 1e-4, (ROWS, COLUMNS, 1, 2, 1, 2))
    displacement = measured(np.ones((ROWS, COLUMNS, 1, 2)), covariance, few)
    with pytest.raises(ReconstructionError, match="3 valid lenslets cannot determine 15 pupil modes"):
        solver_of(covariance, parameters=np.eye(2))(displacement)
    none = measured(np.ones((ROWS, COLUMNS, 1, 2)), covariance, np.zeros_like(ALL))
    with pytest.raises(ReconstructionError, match="0 valid lenslets cannot determine 15 pupil modes"):
        solver_of(covariance, parameters=np.eye(2))(none)
    bridged = solver_of(covariance, is_smooth=True, parameters=np.eye(2))(displacement).wavefront(np.ones(1))
    assert np.isfinite(bridged[few]).all()


def test_zero_slopes_give_flat_wavefront() -> None:
    covariance = np.zeros((ROWS, COLUMNS, 1, 2, 1, 2))
    displacement = measured(np.zeros((ROWS, COLUMNS, 1, 2)), covariance)
    solution = solver_of(covariance, is_smooth=True, parameters=np.eye(2))(displacement)
    np.testing.assert_allclose(solution.wavefront(np.ones(1)), 0, atol=1e-12)
