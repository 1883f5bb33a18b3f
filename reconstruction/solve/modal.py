"""Modal reconstruction: dual-orthogonal coefficients e_pq of the space-variant wavefront, with error bars.

With the displacement of each lenslet written as d = sum_q c_q T_q, every field mode q is an independent least-squares
problem G e_q = (k/f) c_q, G the mean gradients of the pupil modes R_p over the lenslets. For three field modes this is
the paper's e = pinv(M) d. Here the combinations of field modes with independent errors (`weights.whitening`) are
solved instead, with weighted lenslets.

The smoothness prior: each coefficient is normally distributed about zero with standard deviation s n^-5, n the degree
of R_p. For each combination, s and the noise maximise the evidence of the data (MacKay, Neural Computation 4, 415,
1992). So there may be as many modes as the lattice carries, and lost lenslets are bridged by their neighbours.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from scipy import ndimage

from reconstruction.arrays import Floats, Mask
from reconstruction.errors import ReconstructionError
from reconstruction.modes.pupil_modes import PupilModes
from reconstruction.runtime.compilation import compiled
from reconstruction.solve.weights import Whitening

_PRIOR_EXPONENT = 5.0
_UNSEEN = 1e-12  # singular value over the largest, below which it is rounding
# Ratios of prior to noise variance tried: every decade, then every quarter of a decade about the best.
_PRIOR_DECADES = np.linspace(-4.0, 14.0, 19)
_BETWEEN_DECADES = np.linspace(-0.75, 0.75, 7)
_FACTORS = 16  # factors of up to 1e15, whose product does not overflow, per logarithm
_TINY = np.finfo(np.float64).tiny


@dataclass(frozen=True, slots=True, eq=False)
class _WeightedEquations:
    """W G S = u singular vt for each of k combinations; G is (lenslet x xy, pupil_mode - 1), without the piston."""

    weight: Floats  # W^2, (k, lenslet x xy)
    singular: Floats  # (k, pupil_mode - 1), m
    square: Floats  # of `singular` over the largest of all, (k, pupil_mode - 1)
    scaled: Floats  # vt S, with S the prior's n^-5, or 1 without prior; (k, pupil_mode - 1, pupil_mode - 1)
    over_singular: Floats  # scaled / singular; 0 where the slopes do not show a singular vector
    gradients: Floats  # G
    known: Mask  # where the wavefront is known, (lenslet_row, lenslet_column)
    values: Floats  # of the modes there, minus their means, (pupil_mode - 1, known lenslet)

    def along(self, weighted: Floats) -> Floats:
        """Data (k, lenslet x xy) times W^2 along the singular vectors: (k, pupil_mode - 1)."""
        # u = W G S vt^T / singular, of which only G is large, and common to all combinations.
        return np.asarray(np.matvec(self.over_singular, weighted @ self.gradients))

    def inverse(self, gain: Floats) -> Floats:
        """Estimator of each combination with the `gain` (k, pupil_mode - 1): (k, pupil_mode - 1, lenslet x xy)."""
        square = np.swapaxes(self.scaled, 1, 2) @ (gain[..., None] * self.over_singular)
        return np.asarray((square @ self.gradients.T) * self.weight[:, None])


@dataclass(frozen=True, eq=False)
class ModalSolution:
    """Dual-orthogonal coefficients of one wavefront; error bars are computed on request."""

    coefficients: Floats  # e_pq, rad, (pupil_mode, field_mode); zero for the piston
    _whitening: Whitening
    _equations: _WeightedEquations
    _gain: Floats  # 1 / singular, less with the prior: (combination, pupil_mode - 1)
    _prior_variance: Floats  # s^2 of each combination, (combination,); 0 without the prior
    _slopes: Floats  # rad/m, (lenslet x xy, field_mode)
    _valid: Mask  # (lenslet_row, lenslet_column)
    _covariance_of_slopes: Floats  # (rad/m)^2, (lenslet_row, lenslet_column, field_mode, xy, field_mode, xy)

    @property
    def known(self) -> Mask:
        """Lenslets at which the wavefront is known, (lenslet_row, lenslet_column)."""
        return self._equations.known

    def wavefront(self, field_modes: Floats) -> Floats:
        """Wavefront, rad, for values (..., field_mode) of the field modes; see `wavefront.Solution`."""
        phase = field_modes @ (self.coefficients[1:].T @ self._equations.values)
        if phase.shape[-1] == self.known.size:
            return phase.reshape(*phase.shape[:-1], *self.known.shape)
        wavefront = np.full((*phase.shape[:-1], *self.known.shape), np.nan)
        wavefront[..., self.known] = phase
        return wavefront

    def sigma(self, field_modes: Floats) -> Floats:
        """Standard deviation of `wavefront`, rad, the same shape."""
        values = self._equations.values
        flat = field_modes.reshape(-1, field_modes.shape[-1])
        sigma = np.full((len(flat), *self.known.shape), np.nan)
        for view, at in enumerate(np.einsum("vq,vs->vqs", flat, flat)):
            covariance = np.tensordot(at, self._covariance, axes=2)
            sigma[view, self.known] = np.sqrt(np.sum(values * (covariance @ values), axis=0))
        return sigma.reshape(*field_modes.shape[:-1], *self.known.shape)

    @cached_property
    def coefficients_sigma(self) -> Floats:
        """Standard deviation of each coefficient, rad, (pupil_mode, field_mode); zero for the piston."""
        sigma = np.zeros_like(self.coefficients)
        sigma[1:] = np.sqrt(np.einsum("qqpp->pq", self._covariance))
        return sigma

    @property
    def covariance(self) -> Floats:
        """Covariance of the coefficients, rad^2, (pupil_mode - 1, field_mode) twice; without the piston.

        It includes the noise of the slopes and what the prior suppresses.
        """
        return np.transpose(self._covariance, (2, 0, 3, 1))

    @cached_property
    def _slope_covariance(self) -> Floats:  # of the valid lenslets, (lenslet, field_mode, xy, field_mode, xy)
        return self._covariance_of_slopes[self._valid]

    @cached_property
    def _covariance(self) -> Floats:
        """`covariance` as (field_mode, field_mode, pupil_mode - 1, pupil_mode - 1)."""
        forward, back = self._whitening.forward, self._whitening.back
        noise = np.einsum("kq,lqarb,mr->kmlab", forward, self._slope_covariance, forward, optimize=True)
        inverse = self._equations.inverse(self._gain)
        combinations, pupil_modes = inverse.shape[:2]
        covariance = np.empty((combinations, combinations, pupil_modes, pupil_modes))
        for k in range(combinations):
            by_lenslet = inverse[k].reshape(pupil_modes, -1, 2)
            for m in range(k + 1):
                passed_on = np.einsum("pla,lab->plb", by_lenslet, noise[k, m]).reshape(pupil_modes, -1)
                covariance[k, m] = passed_on @ inverse[m].T
                covariance[m, k] = covariance[k, m].T
        scaled = self._equations.scaled
        left = self._prior_variance[:, None] * (1 - self._gain * self._equations.singular) ** 2
        held_back = np.swapaxes(scaled, 1, 2) @ (left[..., None] * scaled)
        covariance[np.arange(combinations), np.arange(combinations)] += held_back
        flat = covariance.reshape(combinations, -1)
        half_way = (back @ flat).reshape(combinations, combinations, -1)
        return np.asarray((back @ half_way).reshape(covariance.shape))

    @cached_property
    def chi_square(self) -> float:
        """Reduced chi-square of the slopes about the fit: about 1 if the misfit is noise."""
        misfit = self._slopes - self._equations.gradients @ self.coefficients[1:]
        variance = np.einsum("lqaqa->laq", self._slope_covariance).reshape(misfit.shape)
        with np.errstate(invalid="ignore", divide="ignore"):
            total = np.sum(misfit**2 / variance)
            return float(total / (misfit.size - np.sum(self._gain * self._equations.singular)))


class ModalSolver:
    """Fits pupil modes to slopes; caches the decomposition for each set of valid lenslets and weights."""

    def __init__(self, modes: PupilModes, whitening: Whitening, *, is_smooth: bool) -> None:
        """Prepare for pupil modes, piston first; `is_smooth` applies the prior."""
        self._modes, self._whitening, self._is_smooth = modes, whitening, is_smooth
        gradients = modes.gradients[1:]
        self._gradients = gradients.reshape(len(gradients), -1)  # (pupil_mode without piston, lenslet x xy), 1/m
        self._scale = modes.degree[1:] ** -_PRIOR_EXPONENT if is_smooth else np.ones(len(gradients))
        self._equations = lru_cache(maxsize=16)(self._decompose)

    def __call__(
        self, slopes: Floats, covariance: Floats, valid: Mask, *, weights: Floats | None = None
    ) -> ModalSolution:
        """Fit the slopes of the valid lenslets inside the pupil.

        Parameters
        ----------
        slopes : (lenslet_row, lenslet_column, field_mode, xy)
            rad/m.
        covariance : (lenslet_row, lenslet_column, field_mode, xy, field_mode, xy)
            Of the slopes, (rad/m)^2.
        valid : bool (lenslet_row, lenslet_column)
        weights : (lenslet_row, lenslet_column), optional
            In any unit.
        """
        valid = valid & self._modes.inside
        weights = np.ones(valid.shape) if weights is None else np.asarray(weights, np.float64)
        equations = self._equations(valid.tobytes(), weights.tobytes())
        measured = np.swapaxes(slopes[valid], 1, 2).reshape(-1, slopes.shape[2])
        data = self._whitening.forward @ measured.T
        weighted = data * equations.weight
        along = equations.along(weighted)
        if self._is_smooth:
            total = np.vecdot(data, weighted)
            ratio, noise = _maximize_evidence(equations.square, along, total, data.shape[1])
            ratio = ratio / np.max(equations.singular) ** 2
            gain = ratio[:, None] * equations.singular / (1 + ratio[:, None] * equations.singular**2)
            prior_variance = ratio * noise
        else:
            gain, prior_variance = 1 / equations.singular, np.zeros(len(along))
        coefficients = np.vecmat(gain * along, equations.scaled)
        return ModalSolution(
            np.concatenate([np.zeros((1, len(along))), (self._whitening.back @ coefficients).T]),
            self._whitening,
            equations,
            gain,
            prior_variance,
            measured,
            valid,
            covariance,
        )

    def _decompose(self, valid_bytes: bytes, weight_bytes: bytes) -> _WeightedEquations:
        valid = np.frombuffer(valid_bytes, np.bool_)
        weights = np.frombuffer(weight_bytes, np.float64)[valid]
        gradients = self._gradients[:, np.repeat(valid, 2)].T
        root_weight = np.sqrt(weights[:, None] * self._whitening.weights[:, None]).reshape(-1, len(gradients))
        # The prior allows fewer slopes than modes: rows of zeros complete the singular vectors.
        modes = gradients.shape[1]
        missing = max(0, modes - len(gradients)) if self._is_smooth else 0
        matrix = np.pad(root_weight[..., None] * gradients * self._scale, ((0, 0), (0, missing), (0, 0)))
        _, singular, vt = np.linalg.svd(np.linalg.qr(matrix, mode="r"))  # u is not needed
        if not self._is_smooth and (singular.shape[1] < modes or np.any(singular[:, -1] < 1e-6 * singular[:, 0])):
            raise ReconstructionError(
                f"{np.count_nonzero(valid)} valid lenslets cannot tell {modes + 1} pupil modes apart:"
                " lower pupil_modes, or leave it out"
            )
        known = valid.reshape(self._modes.inside.shape)
        if self._is_smooth:  # extrapolate by one lenslet only
            known = self._modes.inside & ndimage.binary_dilation(known, structure=np.ones((3, 3), np.bool_))
        values = self._modes.values[1:, known]
        is_seen = singular > _UNSEEN * singular[:, :1]
        scaled = vt * self._scale
        return _WeightedEquations(
            weight=root_weight**2,
            singular=singular,
            square=(singular / np.max(singular)) ** 2,
            scaled=scaled,
            over_singular=np.divide(scaled, singular[..., None], out=np.zeros_like(scaled), where=is_seen[..., None]),
            gradients=gradients,
            known=known,
            values=values - values.mean(axis=1, keepdims=True),
        )


@compiled
def _maximize_evidence(square: Floats, along: Floats, total: Floats, count: int) -> Floats:
    """Most probable ratio of prior to noise variance for each combination, and the noise variance: (2, combination).

    `square` (combination, p): squared singular values, at most 1; `along` (combination, p): the `count` data along the
    singular vectors; `total` (combination,): their sums of squares. Component p has the variance noise (1 + ratio
    square_p), the rest only noise. The noise follows from the ratio in closed form.
    """
    found = np.zeros((2, total.size))
    for k in range(total.size):
        energy = along[k] ** 2
        beyond = max(total[k] - np.sum(energy), 0.0)
        decade = 0.0
        for tried in (_PRIOR_DECADES, _BETWEEN_DECADES):
            around, best = decade, -np.inf
            for between in tried:
                evidence, noise = _evidence(10.0 ** (around + between), square[k], energy, beyond, count)
                if evidence > best:
                    best, decade, found[1, k] = evidence, around + between, noise
        found[0, k] = 10.0**decade
    return found


@compiled
def _evidence(ratio: float, square: Floats, energy: Floats, beyond: float, count: int) -> tuple[float, float]:
    """Log evidence of one ratio, up to a constant, and the most probable noise variance."""
    spread = 1.0 + ratio * square
    noise = max((np.sum(energy / spread) + beyond) / count, _TINY)
    evidence = -count / 2 * np.log(noise)
    for first in range(0, spread.size, _FACTORS):
        evidence -= np.log(np.prod(spread[first : first + _FACTORS])) / 2
    return evidence, noise
