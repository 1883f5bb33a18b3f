"""Distance of one layer, or two, or a sample with depth, and whether layers explain a frame.

The log evidence of the displacements is a smooth function of the distances. It is searched on a coarse grid, then
refined; its curvature at the maximum gives the error bars, to which systematic errors of the displacements are added.
A layer before the lenslets has a negative ratio of field to pupil position; a relay can put one behind them. Noise can
favour a place behind them by far, so layers are sought there only if none before them explain the displacements.

Layers differ in strength. Taken for alike, two are found closer to each other than they are, where they explain less
noise. So the strengths of their priors are found with the distances.

Where two layers are needed, the sample may have depth. A *slab* represents that: three layers, one between the others,
so that two ends are found, as two layers are. It explains two thin layers nearly as well as they do.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Literal

import numpy as np
import scipy  # which loads its parts when they are used

from reconstruction.arrays import Floats
from reconstruction.errors import ReconstructionError
from reconstruction.layers.layer_solver import SKETCH_DEGREE, FrameEquations, LayerFit
from reconstruction.solve.evidence import FitQuality

LayerVerdict = Literal[
    "one layer",
    "two layers",
    "not a single layer",
    "not one or two layers",
    "not the given layers",
    "nothing above the noise",
    "farther than the search reaches",
]

# The search runs over t = ratio / (1 + |ratio|), even between layers at the lenslets (0) and at the source (-1).
_GRID, _GRID_OF_TWO = np.linspace(-0.96, 0.96, 49), np.linspace(-0.95, 0.95, 39)
FARTHEST_RATIO = float(_GRID[-1] / (1 - _GRID[-1]))
_FARTHEST = 0.97  # of |t|
_ROUGH, _TOLERANCE = 2e-3, 1e-4  # of t
_SPACING = float(_GRID[1] - _GRID[0])
_STEP = 2e-3  # of t, for the curvature
_WEAKER, _WEAKEST = 1.0, 7.0  # steps to a weaker layer, and the most of them, in the logarithm of its strength
_SLAB = np.array([[1.0, 0.0], [0.5, 0.5], [0.0, 1.0]])  # from the ends to the layers of a slab
# Misfit beyond that of any wavefront, of all displacements, above which there are other layers; below the first, or the
# second if the source hides displacements, it may be that of the registration. Single screens leave 0.004, and 0.017 in
# noise; two taken for one, or ten, 0.03 to 0.4.
_SYSTEMATIC, _SYSTEMATIC_IF_BLIND, _UNEXPLAINED = 0.015, 0.03, 0.06
# Over the misfit of any wavefront beyond noise: the more this leaves, the more it takes in. Up to 2.4 for single
# screens on imperfect benches, 40 and more for two taken for one.
_SYSTEMATIC_SHARE = 3.0
_MOSTLY_NOISE = 0.7  # misfit above which there is more noise than wavefront
_CHI_SQUARE = 1.5  # reduced, above which misfit is not noise
_DOUBTFUL = 2.0  # reduced, of any wavefront


@dataclass(frozen=True, slots=True, eq=False)
class LayerSearch:
    """Layers found in one frame."""

    ratios: Floats  # tried for a single layer, (n,)
    misfits: Floats  # of a single layer there, (n,)
    chi_squares: Floats  # reduced, of a single layer there, (n,)
    one: LayerFit  # best single layer
    two: LayerFit | None  # best pair, if it was searched
    given: LayerFit | None  # at given distances
    any_wavefront: FitQuality
    slab: LayerFit | None = None  # best slab, if a pair was searched because one layer does not suffice

    @property
    def fit(self) -> LayerFit:
        """The given layers, or those found: a pair that one layer replaces would share its phase arbitrarily."""
        return self.given or (self.one if self.two is None or self._explains(self.one) else self.two)

    @property
    def verdict(self) -> LayerVerdict:
        """Number of layers that explain the displacements, unless the given ones do not."""
        if self.fit.quality.misfit >= _MOSTLY_NOISE and self.fit.quality.chi_square < _CHI_SQUARE:
            return "nothing above the noise"
        if self.given is not None and not self._explains(self.given):
            return "not the given layers"
        if self.given is None and not is_within(self.fit):
            return "farther than the search reaches"
        if len(self.fit.layers) == 1 and self._explains(self.fit):
            return "one layer"
        if len(self.fit.layers) == 1:
            return "not a single layer"
        return "two layers" if self._explains(self.fit) else "not one or two layers"

    @property
    def doubt(self) -> str:
        """Why distances and error bars may be wrong; empty if noise explains what a wavefront leaves."""
        chi_square = min(self.any_wavefront.chi_square, self.fit.quality.chi_square)  # layers may have more modes
        if chi_square < _DOUBTFUL:
            return ""
        return (
            f"no wavefront at all explains the displacements within their errors (reduced chi-square {chi_square:.2g}),"
            " so that distances may be wrong by more than their error bars"
        )

    def _explains(self, fit: LayerFit) -> bool:
        is_noise = fit.quality.chi_square < _CHI_SQUARE * max(self.any_wavefront.chi_square, 1.0)
        is_small = fit.quality.misfit < _MOSTLY_NOISE and _beyond(fit.quality, self.any_wavefront) < _UNEXPLAINED
        return explains(fit.quality, self.any_wavefront) or (is_small and is_noise)


def is_within(fit: LayerFit) -> bool:
    """True if found layers lie within the search, not at its end."""
    return all(abs(layer.ratio) < FARTHEST_RATIO for layer in fit.layers)


def explains(fit: FitQuality, any_wavefront: FitQuality, *, is_blind: bool = False) -> bool:
    """True if a fit explains displacements as well as registration errors allow."""
    not_noise = math.sqrt(max(1 - 1 / max(any_wavefront.chi_square, 1.0), 0.0)) * any_wavefront.misfit
    return fit.misfit < _MOSTLY_NOISE and _beyond(fit, any_wavefront) < systematic_misfit(not_noise, is_blind=is_blind)


def systematic_misfit(not_noise: float = 0.0, *, is_blind: bool) -> float:
    """Misfit of layers beyond that of any wavefront, which itself leaves `not_noise`, by registration errors."""
    return max(_SYSTEMATIC_IF_BLIND if is_blind else _SYSTEMATIC, _SYSTEMATIC_SHARE * not_noise)


def search_layers(
    equations: FrameEquations,
    count: int | None = 1,
    *,
    at: tuple[float, ...] = (),
    check: Callable[[], None] = lambda: None,
) -> LayerSearch:
    """Find the distance of one layer, or two, unless the ratios are given by `at`.

    Without a `count`, two are searched for if one does not explain the displacements and any wavefront does it better.

    `check` is called before each fit; its exception ends the search. Raises `ReconstructionError` for other than one or
    two layers.
    """
    if count not in {None, 1, 2} or len(at) > 2 or len(set(at)) < len(at):
        raise ReconstructionError("one layer can be found, or two, at different distances")

    def sketch_at(*t: float) -> FitQuality:
        check()
        return equations.quality(*map(_ratio, t), degree=SKETCH_DEGREE)

    def best_of(sketches: dict[tuple[float, ...], FitQuality]) -> LayerFit:
        before = [ratios for ratios in sketches if max(ratios) <= 0]
        starts = {max(some, key=lambda t: sketches[t].log_evidence) for some in (before, sketches)}
        fits = []
        for start in sorted(starts, key=max):  # those before the lenslets first
            is_sketched = len(start) == 2 and count is None  # else it would take several times as long
            fits.append(_refined(equations, check, np.array(start), np.eye(len(start)), is_sketched=is_sketched))
            if explains(fits[-1].quality, any_wavefront):
                return fits[-1]
        return max(fits, key=lambda fit: fit.quality.log_evidence)

    any_wavefront = equations.any_wavefront()
    tried: dict[tuple[float, ...], FitQuality] = {(t,): sketch_at(t) for t in _GRID}
    one = best_of(tried)
    two = slab = None
    is_enough = one.quality.log_evidence >= any_wavefront.log_evidence or explains(one.quality, any_wavefront)
    if not at and (count == 2 or (count is None and not is_enough)):
        two = best_of({pair: sketch_at(*pair) for pair in combinations(_GRID_OF_TWO, 2)})
        if count is None:
            ends = np.array([layer.ratio / (1 + abs(layer.ratio)) for layer in two.layers])
            slab = _refined(equations, check, ends, _SLAB, is_sketched=True)
            if two.quality.log_evidence > slab.quality.log_evidence:  # then its ends are these two
                between = equations.fit(*(_SLAB @ [layer.ratio for layer in two.layers]).tolist())
                slab = _placed(between, _SLAB @ two.ratio_covariance @ _SLAB.T)
    return LayerSearch(
        ratios=np.array([_ratio(t) for t in _GRID]),
        misfits=np.array([quality.misfit for quality in tried.values()]),
        chi_squares=np.array([quality.chi_square for quality in tried.values()]),
        one=one,
        two=two,
        given=equations.fit(*sorted(at)) if at else None,
        any_wavefront=any_wavefront,
        slab=slab,
    )


def _ratio(t: float) -> float:
    """Ratio of field to pupil position at the search parameter t."""
    t = min(max(t, -_FARTHEST), _FARTHEST)
    return float(t / (1 - abs(t)))


def _refined(
    equations: FrameEquations, check: Callable[[], None], start: Floats, layers_of: Floats, *, is_sketched: bool = False
) -> LayerFit:
    """Maximise the evidence over some distances, from a start (n,) in t, and find their error bars.

    The ratios of the layers are `layers_of` (layer, n) times those of the distances. The evidence is that of
    all polynomials, or of those of the sketch, which also gives the strengths of the layers.
    """
    count = len(start)

    def ratios(t: Floats) -> list[float]:
        check()
        return (layers_of @ np.vectorize(_ratio)(t)).tolist()  # type: ignore[no-any-return] # of floats

    def strengths_of(logarithms: Floats) -> tuple[float, ...]:  # those within a slab lie between those of its ends
        ends = np.concatenate([[0.0], np.clip(logarithms, -_WEAKEST, _WEAKEST)])
        return tuple(np.exp(layers_of @ ends).tolist())

    def sketched_cost(t: Floats, strengths: tuple[float, ...]) -> float:
        return -equations.quality(*ratios(t), degree=SKETCH_DEGREE, strengths=strengths).log_evidence

    steps = np.concatenate([np.full(count, _SPACING / 2), np.full(count - 1, -_WEAKER)])
    begin = np.concatenate([start, np.zeros(count - 1)])
    rough = _minimum(lambda all_: sketched_cost(all_[:count], strengths_of(all_[count:])), begin, steps, _ROUGH)
    strengths = strengths_of(rough[count:])

    def fit_at(t: Floats) -> LayerFit:
        return equations.fit(*ratios(t), strengths=strengths)

    def cost(t: Floats) -> float:
        return sketched_cost(t, strengths) if is_sketched else -fit_at(t).quality.log_evidence

    refined = _minimum(cost, rough[:count], np.full(count, _SPACING / 8), _TOLERANCE)
    best = np.clip(refined, -_FARTHEST + _STEP, _FARTHEST - _STEP)
    fit = fit_at(best)
    before, after = ([fit_at(best + side * step) for step in _STEP * np.eye(len(best))] for side in (-1, 1))
    systematic = equations.distance_covariance(fit, before, after, _STEP)
    per_t = layers_of * np.array([(1 + abs(_ratio(each))) ** 2 for each in best])
    return _placed(fit, per_t @ (_inverse(_curvature(cost, best)) + systematic) @ per_t.T)


def _placed(fit: LayerFit, covariance: Floats) -> LayerFit:
    """A fit with the covariance of its ratios, its layers in order."""
    order = np.argsort([layer.ratio for layer in fit.layers])
    layers = [
        replace(layer, ratio_sigma=float(sigma))
        for layer, sigma in zip(fit.layers, np.sqrt(np.diag(covariance)), strict=True)
    ]
    return replace(fit, layers=tuple(layers[i] for i in order), ratio_covariance=covariance[np.ix_(order, order)])


def _minimum(cost: Callable[[Floats], float], start: Floats, steps: Floats, tolerance: float) -> Floats:
    """Minimise a cost by the method of Nelder and Mead from a simplex of `steps` (n,) with a corner at `start` (n,)."""
    simplex = start + np.concatenate([np.zeros((1, len(start))), np.diag(steps)])
    options = {"initial_simplex": simplex, "xatol": tolerance, "fatol": 0.02, "maxiter": 200}
    found = scipy.optimize.minimize(cost, start.ravel(), method="Nelder-Mead", options=options)  # type: ignore[call-overload] # its own stubs want 1-D
    return np.asarray(found.x)


def _curvature(cost: Callable[[Floats], float], at: Floats) -> Floats:
    """Second derivatives (n, n) of a function at a position (n,) by central differences."""
    steps = _STEP * np.eye(len(at))
    curvature = np.empty((len(at), len(at)))
    for i, j in np.ndindex(curvature.shape):
        corners = [(a, b, cost(at + a * steps[i] + b * steps[j])) for a in (-1, 1) for b in (-1, 1)]
        curvature[i, j] = sum(a * b * value for a, b, value in corners) / (4 * _STEP**2)
    return curvature


def _inverse(curvature: Floats) -> Floats:
    """Inverse of second derivatives (n, n); without a minimum, the variance is that of the grid."""
    values, vectors = np.linalg.eigh(curvature)
    return np.asarray((vectors * (1 / np.maximum(values, 1 / _SPACING**2))) @ vectors.T)


def _beyond(fit: FitQuality, other: FitQuality) -> float:
    """Misfit of a fit beyond that of another one; 0 if it is smaller."""
    return float(np.sqrt(max(fit.misfit**2 - other.misfit**2, 0.0)))
