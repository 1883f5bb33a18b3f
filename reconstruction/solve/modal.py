"""Modal reconstruction: the dual-orthogonal coefficients e_pq of the space-variant wavefront, with their error bars.

With the displacement of every lenslet written as d = sum_q c_q T_q, each field mode q is an independent least-squares
problem: G e_q = (k/f) c_q, G the mean gradient of the pupil mode R_p over each lenslet. For three field modes this is
the paper's e = pinv(M) d; it holds for any number. Here each of the combinations of field modes whose errors are
independent (`whitening`) is such a problem, and lenslets are weighted: so nothing that was measured is wasted.

With the prior, each coefficient is expected to be normally distributed about zero with the standard deviation s n^-5,
n the degree of R_p: smooth. Each combination's s and the level of what the modes do not explain are those under
which its data are the likeliest (MacKay, Neural Computation 4, 415, 1992). So there may be as many modes as the
lattice carries: those that drown in noise fade out, and a lost lenslet is bridged by what its neighbours say.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from scipy import ndimage

from reconstruction.arrays import Floats, Mask
from reconstruction.errors import ReconstructionError
from reconstruction.modes.pupil_modes import PupilModes
from reconstruction.solve.evidence import maximize_evidence
from reconstruction.solve.whitening import Whitening

_PRIOR_EXPONENT = 5.0
_UNSEEN = 1e-12  # singular value over the largest, below which it is rounding


@dataclass(frozen=True, slots=True, eq=False)
class _WeightedEquations:
    """The weighted, scaled equations of one set of lenslets for each of k combinations: W G S = u singular vt.

    G is (lenslet x xy, pupil_mode - 1); all without the piston.
    """

    weight: Floats  # W^2, (k, lenslet x xy)
    singular: Floats  # (k, pupil_mode - 1), m
    square: Floats  # of them, over the largest of all, (k, pupil_mode - 1)
    scaled: Floats  # vt S, with S the prior's n^-5, or 1 without it; (k, pupil_mode - 1, pupil_mode - 1)
    # The same over the singular values; 0 where the slopes show nothing of a singular vector.
    over_singular: Floats
    gradients: Floats  # G
    known: Mask  # where the wavefront is known, (lenslet_row, lenslet_column); elsewhere it would be invented
    values: Floats  # of the modes there, less their means, (pupil_mode - 1, known lenslet)

    def along(self, weighted: Floats) -> Floats:
        """Data (k, lenslet x xy) times W^2, along the singular vectors: (k, pupil_mode - 1)."""
        # u = W G S vt^T / singular, of which only G is large, and shared by all combinations.
        return np.asarray(np.matvec(self.over_singular, weighted @ self.gradients))

    def inverse(self, gain: Floats) -> Floats:
        """The estimator of each combination with the `gain` (k, pupil_mode - 1): (k, pupil_mode - 1, lenslet x xy)."""
        square = np.swapaxes(self.scaled, 1, 2) @ (gain[..., None] * self.over_singular)
        return np.asarray((square @ self.gradients.T) * self.weight[:, None])


@dataclass(frozen=True, eq=False)
class ModalSolution:
    """The dual-orthogonal coefficients of one wavefront; error bars are computed when they are asked for."""

    coefficients: Floats  # e_pq, rad, (pupil_mode, field_mode); zero for the piston, which slopes do not show
    _whitening: Whitening
    _equations: _WeightedEquations
    _gain: Floats  # 1 / singular, or less where the prior holds: (combination, pupil_mode - 1)
    _prior_variance: Floats  # s^2 of each combination, (combination,); 0 without the prior
    _slopes: Floats  # rad/m, (lenslet x xy, field_mode)
    _valid: Mask  # of which lenslets these are, (lenslet_row, lenslet_column)
    _covariance_of_slopes: Floats  # (rad/m)^2, (lenslet_row, lenslet_column, field_mode, xy, field_mode, xy)

    @property
    def known(self) -> Mask:
        """Where the wavefront is known, (lenslet_row, lenslet_column); elsewhere it would be invented."""
        return self._equations.known

    def wavefront(self, field_modes: Floats) -> Floats:
        """Wavefront, rad, where the field modes have the values (..., field_mode); see `wavefront.Solution`."""
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
        """Covariance of the coefficients but the piston's, rad^2: (pupil_mode - 1, field_mode, the same twice).

        What the noise of the slopes makes, and what the prior holds back: both as the estimator passes them on.
        """
        return np.transpose(self._covariance, (2, 0, 3, 1))

    @cached_property
    def _slope_covariance(self) -> Floats:
        """That of the valid lenslets, (rad/m)^2, (lenslet, field_mode, xy, field_mode, xy)."""
        return self._covariance_of_slopes[self._valid]

    @cached_property
    def _covariance(self) -> Floats:
        """The same as (field_mode, field_mode, pupil_mode - 1, pupil_mode - 1)."""
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
        """Reduced chi-square of the slopes against the fit: about 1 when only noise keeps them apart."""
        misfit = self._slopes - self._equations.gradients @ self.coefficients[1:]
        variance = np.einsum("lqaqa->laq", self._slope_covariance).reshape(misfit.shape)
        with np.errstate(invalid="ignore", divide="ignore"):
            total = np.sum(misfit**2 / variance)
            return float(total / (misfit.size - np.sum(self._gain * self._equations.singular)))


class ModalSolver:
    """Fits pupil modes to the slopes of the lenslets inside the pupil.

    What a set of valid lenslets and weights determines is kept as long as they do not change.
    """

    def __init__(self, modes: PupilModes, whitening: Whitening, *, is_smooth: bool) -> None:
        """Prepare for the modes of a pupil, the piston first; `is_smooth` holds the prior against them."""
        self._modes, self._whitening, self._is_smooth = modes, whitening, is_smooth
        gradients = modes.gradients[1:]
        self._gradients = gradients.reshape(len(gradients), -1)  # (pupil_mode without piston, lenslet x xy), 1/m
        self._scale = modes.degree[1:] ** -_PRIOR_EXPONENT if is_smooth else np.ones(len(gradients))
        self._equations = lru_cache(maxsize=16)(self._decompose)  # of this solver's own

    def __call__(
        self, slopes: Floats, covariance: Floats, valid: Mask, *, weights: Floats | None = None
    ) -> ModalSolution:
        """Fit the slopes (lenslet_row, lenslet_column, field_mode, xy), rad/m, of the valid lenslets.

        `covariance` (lenslet_row, lenslet_column, field_mode, xy, field_mode, xy), (rad/m)^2, becomes that of the
        coefficients; `weights` (lenslet_row, lenslet_column) say how much each lenslet counts, in any unit.
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
            ratio, noise = maximize_evidence(equations.square, along, total, data.shape[1])
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
        """Set up and decompose the equations of the valid lenslets."""
        valid = np.frombuffer(valid_bytes, np.bool_)
        weights = np.frombuffer(weight_bytes, np.float64)[valid]
        gradients = self._gradients[:, np.repeat(valid, 2)].T
        root_weight = np.sqrt(weights[:, None] * self._whitening.weights[:, None]).reshape(-1, len(gradients))
        # With the prior, fewer slopes than modes are no obstacle: rows of zeros keep the vectors complete.
        modes = gradients.shape[1]
        missing = max(0, modes - len(gradients)) if self._is_smooth else 0
        matrix = np.pad(root_weight[..., None] * gradients * self._scale, ((0, 0), (0, missing), (0, 0)))
        _, singular, vt = np.linalg.svd(np.linalg.qr(matrix, mode="r"))  # u follows from them
        if not self._is_smooth and (singular.shape[1] < modes or np.any(singular[:, -1] < 1e-6 * singular[:, 0])):
            raise ReconstructionError(
                f"{np.count_nonzero(valid)} valid lenslets cannot tell {modes + 1} pupil modes apart:"
                " lower pupil_modes, or leave it out"
            )
        known = valid.reshape(self._modes.inside.shape)
        if self._is_smooth:  # what the neighbours say of a lost lenslet is worth saying; further away it is invented
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
