"""Wavefronts of layers against closed forms and the scatter of many draws, and the choice of what to assume."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
from scipy.special import ndtri
from support.optics import FIELD
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
from reconstruction.layers.layer_search import LayerSearch, search_layers
from reconstruction.layers.layer_solver import FrameEquations, Layer, LayerFit, LayerModes
from reconstruction.layers.layered_wavefront import FREE, AssumedSample, LayeredWavefronts, most_probable
from reconstruction.modes.field_modes import gradient_basis
from reconstruction.solve.evidence import FitQuality
from reconstruction.solve.modal import ModalSolution

SOLVER = solver()
WAVEFRONTS = LayeredWavefronts(SOLVER, LayerModes(SOLVER.degree, SENSOR, FIELD, MODES), gradient_basis(MODES))
NEAR, FAR = -0.4, -1.6
VIEWS_M = [(0.0, 0.0), (0.5e-3, -0.3e-3), (-0.5e-3, -0.5e-3)]


def at(x_m: float, y_m: float) -> Floats:
    """Field modes at a field position, (field_mode,)."""
    return np.asarray(MODES.values(x_m / FIELD.half_width_m, y_m / FIELD.half_width_m))


@pytest.mark.parametrize("ratio", [-0.975, 0.5])
def test_wavefront_is_that_of_the_layer(ratio: float) -> None:
    solution = WAVEFRONTS(displacement(displacements_px(PHASE, ratio)), None, AssumedSample((ratio,)))
    for x_m, y_m in VIEWS_M:
        true = wavefront(PHASE, ratio, x_m, y_m)
        np.testing.assert_allclose(solution.wavefront(at(x_m, y_m)), true, atol=3e-3 * float(np.std(true)))


def test_wavefront_of_two_layers_is_their_sum() -> None:
    """Also with lost lenslets, beside which it is known."""
    both = displacements_px(PHASE, NEAR) + displacements_px(OTHER, FAR)
    solution = WAVEFRONTS(displacement(both, lost=3), None, AssumedSample((NEAR, FAR)))
    assert solution.known.all()
    for x_m, y_m in VIEWS_M:
        true = wavefront(PHASE, NEAR, x_m, y_m) + wavefront(OTHER, FAR, x_m, y_m)
        np.testing.assert_allclose(solution.wavefront(at(x_m, y_m)), true, atol=0.01 * float(np.std(true)))


@pytest.mark.parametrize("ratio", [-0.975, 1e-3, 1e-7])
def test_prepared_numbers_are_normal(ratio: float) -> None:
    """With others, sums take fifty times as long; a layer near the lenslets hardly changes over the field."""
    prepared = WAVEFRONTS._prepared((ratio,)).wavefronts
    assert np.abs(prepared[prepared != 0]).min() > np.finfo(np.float32).tiny


@pytest.mark.parametrize("lost", [0, 20])
@pytest.mark.parametrize("name", ["one", "two"])
def test_prepared_solve_equals_the_full_fit(name: str, lost: int) -> None:
    """Wavefront and displacements: the design times the layers' polynomials."""
    ratios = (-0.8,) if name == "one" else (FAR, NEAR)
    measured = displacement(noisy(SAMPLES[name](), 1), lost=lost)
    found, full = WAVEFRONTS(measured, None, AssumedSample(ratios)), FrameEquations(SOLVER, measured).fit(*ratios)
    expected = full.wavefront(SENSOR, *VIEWS_M[1])
    assert np.std((found.wavefront(at(*VIEWS_M[1])) - expected)[found.known]) < 1e-3 * np.std(expected)
    explained = sum(SOLVER.rows(layer.ratio, SOLVER.degree) @ layer.coefficients for layer in full.layers)
    px = np.matvec(SOLVER.errors.colour, explained) @ gradient_basis(MODES)
    expected = np.swapaxes(px.reshape(*measured.valid.shape, 2, -1), 2, 3)
    np.testing.assert_allclose(found.displacement, expected, atol=2e-4 * np.abs(expected).max())


@pytest.mark.slow
@pytest.mark.parametrize("distance", ["known", "found"])
def test_sigma_covers_the_truth(distance: str) -> None:
    """Also where the error of the distance is larger than all others together."""
    ratio, sigma, draws = -0.975, 0.02, 40
    strength = 4 if distance == "found" else 1
    clean, errors, sigmas = displacements_px(strength * PHASE, ratio), [], []
    for seed, deviation in enumerate(ndtri((np.arange(draws) + 0.5) / draws)):  # evenly drawn
        assumed = AssumedSample((ratio,))
        if distance == "found":
            assumed = AssumedSample((ratio + sigma * deviation,), np.array([[sigma**2]]))
        solution = WAVEFRONTS(displacement(noisy(clean, seed)), None, assumed)
        for view_m in VIEWS_M:
            errors.append(solution.wavefront(at(*view_m)) - strength * wavefront(PHASE, ratio, *view_m))
            sigmas.append(solution.sigma(at(*view_m)))
    share = np.mean(np.abs(errors) < np.array(sigmas))
    assert share == pytest.approx(0.683, abs=0.08)
    if distance == "found":
        known = WAVEFRONTS(displacement(noisy(clean, 0)), None, AssumedSample((ratio,)))
        assert np.mean(sigmas[0]) > 2 * np.mean(known.sigma(at(*VIEWS_M[0])))


def test_faint_lenslets_count_less() -> None:
    measured, sample = displacement(noisy(displacements_px(PHASE / 10, -0.975), 3)), AssumedSample((-0.975,))
    weights = np.where(np.arange(measured.valid.size) % 3, 1.0, 1 / 16).reshape(measured.valid.shape)
    found = WAVEFRONTS(measured, weights, sample)
    expected = FrameEquations(SOLVER, measured, weights).fit(-0.975).wavefront(SENSOR, *VIEWS_M[1])
    assert np.std(found.wavefront(at(*VIEWS_M[1])) - expected) < 1e-3 * np.std(expected)
    assert found.sigma(at(0, 0)).mean() > 1.1 * WAVEFRONTS(measured, None, sample).sigma(at(0, 0)).mean()


@pytest.mark.parametrize("name", ["one", "two"])
def test_error_bars_behind_a_sample_with_depth_are_larger_until_it_is_corrected(name: str) -> None:
    """By what errors of 6 lenslets that are alike add: their share of the variance, of one layer squared."""
    ratios = (-0.8,) if name == "one" else (FAR, NEAR)
    measured = displacement(noisy(SAMPLES[name](), 1))
    once, corrected = (
        WAVEFRONTS(measured, None, AssumedSample(ratios), is_corrected=each).sigma(at(0, 0)) for each in (False, True)
    )
    share = SYSTEMATIC_PX**2 / (SYSTEMATIC_PX**2 + NOISE_PX**2)
    most = math.sqrt((1 + 5 * share) / (1 + 5 * share**2))  # where the prior determines nothing
    expected = 1.0 if name == "one" else most
    assert np.nanmedian(once / corrected) == pytest.approx(expected, rel=0.02)
    assert np.nanmax(once / corrected) <= expected * (1 + 1e-6)


def test_too_few_lenslets_are_refused() -> None:
    few = displacement(displacements_px(PHASE, 0.6), lost=math.prod(SENSOR.lenslets) - 8)
    with pytest.raises(ReconstructionError, match="at least 9 valid lenslets"):
        WAVEFRONTS(few, None, AssumedSample((0.6,)))


def unlayered() -> Floats:
    """Displacements of a wavefront that two layers cannot make, px: six layers all over the depth."""
    generator = np.random.default_rng(3)
    degree = np.add.outer(np.arange(5), np.arange(5))
    phases = np.where((degree > 1) & (degree < 5), generator.normal(0, 2, (6, 5, 5)) / 2.0**degree, 0)
    ratios = (-3.0, -1.5, -0.7, -0.2, 0.3, 1.0)
    return np.asarray(sum(displacements_px(phase, ratio) for phase, ratio in zip(phases, ratios, strict=True)))


def deep() -> list[tuple[Floats, float]]:
    """Phases and ratios of five layers between `NEAR` and `FAR`."""
    generator = np.random.default_rng(5)
    degree = np.add.outer(np.arange(7), np.arange(7))
    phases = np.where((degree > 1) & (degree < 7), generator.normal(0, 20, (5, 7, 7)) / np.maximum(degree, 1) ** 3, 0)
    return list(zip(phases, np.linspace(FAR, NEAR, 5).tolist(), strict=True))


SAMPLES = {
    "one": lambda: displacements_px(PHASE, -0.975),
    "two": lambda: displacements_px(3 * PHASE, NEAR) + displacements_px(3 * OTHER, FAR),
    "deep": lambda: np.sum([displacements_px(phase, ratio) for phase, ratio in deep()], axis=0),
    "more": unlayered,
}


@cache
def searched(name: str) -> LayerSearch:
    return search_layers(FrameEquations(SOLVER, displacement(noisy(SAMPLES[name](), 0))), None)


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize(("name", "layers"), [("one", 1), ("two", 3), ("deep", 3), ("more", 0)])
def test_most_probable_sample_is_assumed(name: str, layers: int) -> None:
    search = searched(name)
    assert len(most_probable(search).ratios) == layers
    assert (search.two is None) == (layers == 1)  # not searched where one layer suffices
    assert len(most_probable(search, may_be_free=False).ratios) in {1, 3}
    assert len(most_probable(search, may_be_free=False, is_blind=True).ratios) in {1, 2}
    if not layers:
        assert most_probable(search) is FREE


@pytest.mark.slow
@pytest.mark.long
def test_slab_stands_for_a_sample_with_depth() -> None:
    """Its middle follows from its ends; its error is less than half that of two layers."""
    layers, measured, search = deep(), displacement(noisy(SAMPLES["deep"](), 0)), searched("deep")
    assert search.two is not None
    assumed, two = most_probable(search), AssumedSample(tuple(layer.ratio for layer in search.two.layers))
    assert assumed.ratios == pytest.approx((FAR, (FAR + NEAR) / 2, NEAR), abs=0.2)
    assert assumed.ratios[1] == pytest.approx((assumed.ratios[0] + assumed.ratios[2]) / 2)
    assert assumed.covariance is not None
    assert np.linalg.matrix_rank(assumed.covariance, 1e-6 * np.max(assumed.covariance)) == 2

    def error_rad(sample: AssumedSample) -> float:
        found = WAVEFRONTS(measured, None, sample)
        each = [
            found.wavefront(at(*view_m)) - sum(wavefront(phase, ratio, *view_m) for phase, ratio in layers)
            for view_m in VIEWS_M
        ]
        return float(np.std(each))

    assert error_rad(assumed) < error_rad(two) / 2


@pytest.mark.slow
def test_sigma_holds_the_scatter_by_the_ends_of_a_slab() -> None:
    """They move together, and the middle with them; apart, the wavefront would change by more."""
    measured, ends = displacement(SAMPLES["deep"]()), np.array([FAR, NEAR])
    covariance, middle = 1e-4 * np.array([[4.0, 3.8], [3.8, 4.0]]), np.array([[1.0, 0.0], [0.5, 0.5], [0.0, 1.0]])

    def of_slab(ends: Floats, covariance: Floats | None = None) -> ModalSolution:
        return WAVEFRONTS(measured, None, AssumedSample(tuple((middle @ ends).tolist()), covariance))

    drawn = np.random.default_rng(1).multivariate_normal(ends, covariance, 200)
    view = at(*VIEWS_M[1])
    scatter = np.var([of_slab(each).wavefront(view) for each in drawn], axis=0)
    beyond = of_slab(ends, middle @ covariance @ middle.T).sigma(view) ** 2 - of_slab(ends).sigma(view) ** 2
    assert np.mean(beyond) == pytest.approx(np.mean(scatter), rel=0.3)
    assert np.corrcoef(beyond.ravel(), scatter.ravel())[0, 1] > 0.9


def fit_of(quality: FitQuality, *ratios: float) -> LayerFit:
    nothing = np.zeros(0)
    layers = tuple(Layer(ratio, 0.1, nothing, nothing, np.zeros((0, 0)), 1) for ratio in ratios)
    return LayerFit(layers, quality, np.eye(len(ratios)))


@pytest.mark.parametrize(
    ("one", "two", "ratios", "is_blind", "expected"),
    [
        # One layer leaves systematic errors, which make a second one and any wavefront more probable.
        (FitQuality(-900, 0.3, 0.006), FitQuality(-100, 0.1, 0.002), (-9.0, 3.0), False, (-9.0,)),
        # It leaves more: here two layers are there,
        (FitQuality(-900, 90.0, 0.17), FitQuality(-100, 0.1, 0.002), (-1.1, -0.3), False, (-1.1, -0.3)),
        # but there none at the end of the search,
        (FitQuality(-900, 9.0, 0.04), FitQuality(-100, 0.1, 0.002), (-9.0, 30.0), False, ()),
        # and the wavefront is not free where the source does not show it.
        (FitQuality(-900, 2.0, 0.02), FitQuality(-100, 0.1, 0.002), (-9.0, 30.0), True, (-9.0,)),
        (FitQuality(-900, 90.0, 0.17), FitQuality(-800, 80.0, 0.15), (-1.1, -0.3), True, ()),
        # Noise that layers and any wavefront explain alike.
        (FitQuality(-300, 1.0, 0.98), FitQuality(-299, 1.0, 0.98), (-1.1, -0.3), True, ()),
    ],
)
def test_systematic_errors_do_not_decide(
    one: FitQuality, two: FitQuality, ratios: tuple[float, ...], expected: tuple[float, ...], *, is_blind: bool
) -> None:
    none, any_wavefront = np.zeros(0), FitQuality(-200, 0.1, 0.003) if one.misfit < 0.5 else FitQuality(-298, 1.0, 0.98)
    search = LayerSearch(none, none, none, fit_of(one, -9.0), fit_of(two, *ratios), None, any_wavefront)
    assert most_probable(search, is_blind=is_blind).ratios == expected


@pytest.mark.parametrize(
    ("evidence_of_slab", "far", "is_blind", "expected"),
    [
        (-110, -1.2, True, ((-1.1, -0.3), (-1.2, -0.7, -0.2))),
        (-90, -1.2, True, ((-1.1, -0.3), (-1.2, -0.7, -0.2))),
        (-131, -1.2, True, ((-1.1, -0.3), ())),  # two layers are decisively more probable
        (-90, -30.0, True, ((-1.1, -0.3), ())),  # beyond the search
        (-110, -1.2, False, ((-1.2, -0.7, -0.2), ())),
    ],
)
def test_slab_is_a_rival_where_the_source_is_blind(
    evidence_of_slab: float, far: float, expected: tuple[tuple[float, ...], ...], *, is_blind: bool
) -> None:
    none, slab = np.zeros(0), fit_of(FitQuality(evidence_of_slab, 1.0, 0.02), far, -0.7, -0.2)
    one, two = fit_of(FitQuality(-900, 90.0, 0.17), -9.0), fit_of(FitQuality(-100, 1.0, 0.02), -1.1, -0.3)
    found = LayerSearch(none, none, none, one, two, None, FitQuality(-200, 1.0, 0.02), slab)
    assumed = most_probable(found, is_blind=is_blind)
    assert (assumed.ratios, assumed.rivals) == expected


@pytest.mark.parametrize("covariance", [None, 1e-4 * np.eye(2)])
def test_sigma_holds_the_difference_to_rivals(covariance: Floats | None) -> None:
    measured, view, rivals = displacement(SAMPLES["two"]()), at(*VIEWS_M[1]), (FAR, (FAR + NEAR) / 2, NEAR)
    alone, beside = AssumedSample((FAR, NEAR), covariance), AssumedSample((FAR, NEAR), covariance, rivals)
    found, other = (WAVEFRONTS(measured, None, each) for each in (beside, AssumedSample(rivals)))
    difference = other.wavefront(view) - found.wavefront(view)
    beyond = found.sigma(view) ** 2 - WAVEFRONTS(measured, None, alone).sigma(view) ** 2
    np.testing.assert_allclose(beyond, difference**2, rtol=0.01, atol=1e-3 * np.max(difference**2))
    assert np.max(np.abs(difference)) > 1e-3


@pytest.mark.slow
def test_error_of_the_distance_is_kept() -> None:
    search = searched("one")
    assumed = most_probable(search)
    np.testing.assert_allclose(assumed.sigma, [layer.ratio_sigma for layer in search.one.layers])
    assert abs(assumed.ratios[0] + 0.975) < 4 * assumed.sigma[0]
    assert assumed.sigma[0] < NOISE_PX
    assert FREE.sigma.shape == (0,)
