"""Layers found in displacements computed in closed form from polynomial phases."""

import gc
import math
import weakref
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from numpy.polynomial import polynomial as powers
from support.polynomial_layers import (
    MODES,
    NOISE_PX,
    OTHER,
    PHASE,
    SENSOR,
    displacement,
    displacements_px,
    noisy,
    solver,
    wavefront,
)

from reconstruction.arrays import Floats
from reconstruction.displacement import SYSTEMATIC_PX
from reconstruction.errors import ReconstructionError
from reconstruction.layers.layer_search import FARTHEST_RATIO, search_layers
from reconstruction.layers.layer_solver import FrameEquations, Layer, LayerFit
from reconstruction.modes.field_modes import LegendreModes, gradient_basis
from reconstruction.solve.evidence import FitQuality

SOLVER = solver()


def equations(coefficients: Floats, *, lost: int = 0) -> FrameEquations:
    return FrameEquations(SOLVER, displacement(coefficients, lost=lost))


@pytest.mark.parametrize("ratio", [0.0, 6.0, -1.5])
def test_distance_and_phase_of_a_polynomial_layer(ratio: float) -> None:
    found = search_layers(equations(displacements_px(PHASE, ratio)))
    (layer,) = found.fit.layers
    assert layer.ratio == pytest.approx(ratio, rel=2e-3, abs=2e-3)
    assert found.verdict == "one layer"
    x_m, y_m = (np.linspace(-half_m, half_m, 21) * 0.9 for half_m in layer.half_width_m)
    true = powers.polygrid2d(y_m * 1e3, x_m * 1e3, PHASE)
    difference = layer.phase(x_m, y_m[:, None]) - true
    assert np.std(difference) < 2e-3 * np.std(true)
    assert np.isnan(layer.phase(np.array(1.01 * layer.half_width_m[0]), np.array(0.0)))


def test_wavefront_of_a_layer_at_any_field_position() -> None:
    fit = equations(displacements_px(PHASE, -0.8)).fit(-0.8)
    true = wavefront(PHASE, -0.8, 0.3e-3, -0.5e-3)
    np.testing.assert_allclose(fit.wavefront(SENSOR, 0.3e-3, -0.5e-3), true, atol=5e-3 * float(np.std(true)), rtol=0)


def test_error_bar_of_the_distance_is_the_width_of_the_evidence() -> None:
    """The evidence is a normal distribution of the ratio, and there is no systematic error."""
    ratio, sigma = -1.5, 0.02

    def quality(tried: float, **_: object) -> FitQuality:
        return FitQuality(-(((tried - ratio) / sigma) ** 2) / 2, chi_square=1.0, misfit=0.0)

    def fit(tried: float, **_: object) -> LayerFit:
        layer = Layer(tried, math.nan, np.ones(2), np.zeros(2), np.zeros((2, 1)), 1)
        return LayerFit((layer,), quality(tried), np.zeros((1, 1)))

    frame = SimpleNamespace(quality=quality, fit=fit, any_wavefront=lambda: quality(ratio))
    frame.distance_covariance = lambda *_: np.zeros((1, 1))
    (layer,) = search_layers(cast("FrameEquations", frame)).fit.layers
    assert layer.ratio_sigma == pytest.approx(sigma, rel=0.01)


@pytest.mark.slow
@pytest.mark.long
def test_error_bars_of_the_distance_cover_the_truth() -> None:
    clean, ratio, draws = displacements_px(PHASE / 4, -0.975), -0.975, 40
    found = [search_layers(equations(noisy(clean, seed))).fit.layers[0] for seed in range(draws)]
    pulls = np.array([(layer.ratio - ratio) / layer.ratio_sigma for layer in found])
    assert 0.75 < np.sqrt(np.mean(pulls**2)) < 1.25  # 2.2 standard errors of 40 draws
    assert abs(np.mean(pulls)) < 3 / math.sqrt(draws)
    assert 1e-4 < found[0].ratio_sigma < 0.05


@pytest.mark.slow
@pytest.mark.long
def test_error_bars_of_the_distance_cover_systematic_errors() -> None:
    """The parameters of every warp are mixed by 0.165 % in the same way for all lenslets, and the noise is small."""
    clean, ratio, draws, prepared = displacements_px(20 * PHASE, -0.975), -0.975, 20, solver(hidden=3)
    parameters = gradient_basis(MODES).reshape(-1, 2, MODES.count)  # orthonormal
    pulls = []
    for seed in range(draws):
        error = 0.00165 * np.random.default_rng(seed).normal(size=(len(parameters), len(parameters)))
        mixed = np.einsum("kxq,kj,jyp,rcpy->rcqx", parameters, error, parameters, clean, optimize=True)
        layer = search_layers(FrameEquations(prepared, displacement(noisy(clean + mixed, seed)))).fit.layers[0]
        pulls.append((layer.ratio - ratio) / layer.ratio_sigma)
    assert 0.6 < np.sqrt(np.mean(np.square(pulls))) < 1.4  # 2.5 standard errors of 20 draws


def test_error_bars_of_the_phase_cover_the_truth() -> None:
    clean, ratio = displacements_px(PHASE / 4, 0.6), 0.6
    x_m = np.linspace(-1.5e-3, 1.5e-3, 7)
    true = powers.polygrid2d(x_m * 1e3, x_m * 1e3, PHASE / 4)
    pulls = []
    for seed in range(40):
        (layer,) = equations(noisy(clean, seed)).fit(ratio).layers
        pulls.append((layer.phase(x_m, x_m[:, None]) - true) / layer.sigma(x_m, x_m[:, None]))
    spread = np.std(pulls, axis=0)  # without what is common to all draws, such as the piston
    assert 0.7 < np.sqrt(np.mean(spread**2)) < 1.1  # the prior knows a part


def test_equations_are_freed_with_their_last_user() -> None:
    """A live window makes them several times a second, with hundreds of megabytes."""
    found = equations(noisy(displacements_px(PHASE, -0.975), 1))
    found.fit(0.9)
    kept = weakref.ref(found)
    gc.disable()
    try:
        del found
        assert kept() is None
    finally:
        gc.enable()


def test_lost_lenslets_are_left_out() -> None:
    clean = displacements_px(PHASE, -0.975)
    assert search_layers(equations(clean, lost=20)).fit.layers[0].ratio == pytest.approx(-0.975, rel=2e-3)
    with pytest.raises(ReconstructionError, match="at least 9 valid lenslets"):
        equations(clean, lost=clean.shape[0] * clean.shape[1] - 8)


@pytest.mark.slow
@pytest.mark.long
def test_two_layers_are_told_from_one() -> None:
    both = displacements_px(3 * PHASE, 0.4) + displacements_px(3 * OTHER, 1.6)
    found = search_layers(equations(noisy(both, 0)), 2)
    assert search_layers(equations(noisy(both, 0))).verdict == "not a single layer"
    assert found.verdict == "two layers"
    near, far = found.fit.layers
    assert near.ratio == pytest.approx(0.4, abs=4 * near.ratio_sigma + 0.01)
    assert far.ratio == pytest.approx(1.6, abs=4 * far.ratio_sigma + 0.03)
    for layer, phase in ((near, 3 * PHASE), (far, 3 * OTHER)):
        x_m, y_m = (np.linspace(-half_m, half_m, 31) * 0.8 for half_m in layer.half_width_m)
        error = slopes_without_tilt(layer.phase(x_m, y_m[:, None]) - powers.polygrid2d(y_m * 1e3, x_m * 1e3, phase))
        true = slopes_without_tilt(powers.polygrid2d(y_m * 1e3, x_m * 1e3, phase))
        assert error < 0.08 * true


@pytest.mark.slow
@pytest.mark.parametrize("strengths", [(1.0, 0.07), (0.1, 1.0)])
def test_layers_of_different_strength_are_found_where_they_are(strengths: tuple[float, float]) -> None:
    """With priors of the same strength the weaker one was found at the stronger, with errors of 0.003."""
    random, degree, true = np.random.default_rng(1), np.add.outer(np.arange(7), np.arange(7)), (-1.05, -0.35)
    phases = [np.where((degree > 1) & (degree < 7), random.normal(0, 2, (7, 7)) / 2.0**degree, 0) for _ in true]
    both = sum(
        strength * displacements_px(phase, ratio)
        for strength, phase, ratio in zip(strengths, phases, true, strict=True)
    )
    found = search_layers(equations(noisy(np.asarray(both), 1)), 2).two
    assert found is not None
    for layer, ratio in zip(found.layers, true, strict=True):
        assert layer.ratio == pytest.approx(ratio, abs=3 * layer.ratio_sigma)
        assert layer.ratio_sigma < 0.15


def slopes_without_tilt(phase: Floats) -> float:
    along_y, along_x = np.gradient(phase)
    slopes = np.stack([along_x, along_y], axis=-1)
    return float(np.sqrt(np.mean((slopes - slopes.mean(axis=(0, 1))) ** 2)))


@pytest.mark.slow
@pytest.mark.long
def test_many_layers_are_neither_one_nor_two() -> None:
    random = np.random.default_rng(3)
    degree = np.add.outer(np.arange(7), np.arange(7))
    layers = [np.where((degree > 1) & (degree < 7), random.normal(0, 2, (7, 7)) / 2.0**degree, 0) for _ in range(10)]
    total = sum(displacements_px(phase, 0.25 * k) for k, phase in enumerate(layers))
    assert search_layers(equations(noisy(np.asarray(total), 1)), 2).verdict == "not one or two layers"


@pytest.mark.parametrize(("noise", "is_doubtful"), [(1.0, False), (3.0, True)])
def test_displacements_beyond_their_errors_are_told(noise: float, is_doubtful: bool) -> None:
    """Of noise three times as strong as expected, nine times the chi-square remains whatever the wavefront."""
    clean = displacements_px(20 * PHASE, -0.975)
    found = search_layers(equations(clean + noise * (noisy(clean, 2) - clean)))
    expected = noise**2 / (1 + (SYSTEMATIC_PX / NOISE_PX) ** 2)  # the expected error includes the systematic one
    assert found.any_wavefront.chi_square == pytest.approx(expected, rel=0.1)
    assert found.verdict == "one layer"
    assert ("no wavefront at all explains the displacements" in found.doubt) == is_doubtful


@pytest.mark.slow
def test_layers_of_opposite_sides_are_found() -> None:
    """One before the lenslets, one behind them, as a relay can put it."""
    both = displacements_px(3 * PHASE, -1.2) + displacements_px(3 * OTHER, 0.5)
    found = search_layers(equations(noisy(both, 0)), None)
    assert found.verdict == "two layers"
    before, behind = found.fit.layers
    assert before.ratio == pytest.approx(-1.2, abs=4 * before.ratio_sigma + 0.02)
    assert behind.ratio == pytest.approx(0.5, abs=4 * behind.ratio_sigma + 0.02)


def test_layers_before_the_lenslets_are_preferred_if_they_explain() -> None:
    """A pair with a layer behind the lenslets has more evidence, and explains the frame, too."""
    before, behind = (-0.3, -0.1), (-0.9, 0.5)

    def quality(*ratios: float, **_: object) -> FitQuality:
        if len(ratios) == 1:
            return FitQuality(-1e4, chi_square=50.0, misfit=0.5)
        tried = np.array(sorted(ratio / (1 + abs(ratio)) for ratio in ratios))
        evidence = max(-1e4 * np.sum((tried - before) ** 2), 500 - 1e4 * np.sum((tried - behind) ** 2))
        return FitQuality(float(evidence), chi_square=1.0, misfit=0.0 if evidence > -500 else 0.5)

    def fit(*ratios: float, **_: object) -> LayerFit:
        layers = [Layer(ratio, math.nan, np.ones(2), np.zeros(2), np.zeros((2, 1)), 3) for ratio in ratios]
        return LayerFit(tuple(layers), quality(*ratios), np.zeros((2, 2)))

    frame = SimpleNamespace(
        quality=quality,
        fit=fit,
        any_wavefront=lambda: FitQuality(1e3, chi_square=1.0, misfit=0.0),
        distance_covariance=lambda _, before, *__: np.zeros((len(before),) * 2),
    )
    found = search_layers(cast("FrameEquations", frame), 2)
    ratios = [layer.ratio for layer in found.fit.layers]
    assert [ratio / (1 + abs(ratio)) for ratio in ratios] == pytest.approx(before, abs=0.01)


def test_given_distances_are_kept() -> None:
    found = search_layers(equations(displacements_px(PHASE, -0.975)), at=(0.5,))
    assert found.fit.layers[0].ratio == 0.5
    assert math.isnan(found.fit.layers[0].ratio_sigma)
    assert found.fit.quality.misfit > 10 * found.one.quality.misfit


def test_one_field_position_has_no_distance() -> None:
    with pytest.raises(ReconstructionError, match="change over the field"):
        solver(LegendreModes(1))


def test_no_displacement_has_no_layer() -> None:
    with pytest.raises(ReconstructionError, match="all zero"):
        equations(np.zeros_like(displacements_px(PHASE, 0.0)))


@pytest.mark.slow
def test_noise_alone_has_no_layer() -> None:
    nothing = np.zeros_like(displacements_px(PHASE, 0.0))
    for seed in range(3):
        assert search_layers(equations(noisy(nothing, seed))).verdict == "nothing above the noise"


def test_layer_beyond_the_search_is_told() -> None:
    found = search_layers(equations(displacements_px(PHASE, -80.0)))
    assert found.verdict == "farther than the search reaches"
    assert found.one.layers[0].ratio < -FARTHEST_RATIO


@pytest.mark.slow
@pytest.mark.long
def test_second_layer_is_not_invented() -> None:
    found = search_layers(equations(noisy(displacements_px(PHASE, -0.975), 1)), 2)
    assert found.two is not None
    assert found.verdict == "one layer"
    (layer,) = found.fit.layers
    assert layer.ratio == pytest.approx(-0.975, rel=0.02)


@pytest.mark.slow
def test_verdict_on_given_layers_is_theirs() -> None:
    clean = displacements_px(PHASE, 0.8) + displacements_px(OTHER, 0.3)
    measured = equations(clean)
    assert search_layers(measured, at=(0.8,)).verdict == "not the given layers"
    assert search_layers(measured, at=(0.8, 0.3)).verdict == "two layers"
    assert search_layers(equations(displacements_px(PHASE, 0.8)), at=(0.8,)).verdict == "one layer"


@pytest.mark.parametrize(("count", "at"), [(0, ()), (3, ()), (1, (0.1, 0.1)), (1, (0.1, 0.2, 0.3))])
def test_impossible_numbers_of_layers_are_refused(count: int, at: tuple[float, ...]) -> None:
    with pytest.raises(ReconstructionError, match="one layer can be found, or two, at different distances"):
        search_layers(equations(displacements_px(PHASE, 0.8)), count, at=at)
