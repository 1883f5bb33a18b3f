"""Modal reconstruction: the dual-orthogonal coefficients e_pq of the space-variant wavefront, with their error bars.

With the displacement of every lenslet written as d = sum_q c_q T_q, each field mode q is an independent least-squares
problem with one and the same matrix: G e_q = (k/f) c_q, G the mean gradient of the pupil mode R_p over each lenslet.
For three field modes this is the paper's e = pinv(M) d; it holds for any number. Lenslets are weighted.

With the prior, e_pq is expected to be normally distributed about zero with the standard deviation s_q n^-6, n the
degree of R_p: smooth. Each field mode's s_q and the level of what the modes do not explain are those under
which its data are the likeliest (MacKay, Neural Computation 4, 415, 1992). So there may be as many modes as the
lattice carries: those that drown in noise fade out, and a lost lenslet is bridged by what its neighbours say.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from reconstruction.displacement import Mask
from reconstruction.errors import ReconstructionError
from reconstruction.geometry import Floats
from reconstruction.pupil_modes import PupilModes

_PRIOR_EXPONENT = 6.0
_PRIOR_RATIOS = 10.0 ** np.linspace(-4.0, 14.0, 73)  # tried for prior over noise, both as variances


@dataclass(frozen=True, slots=True, eq=False)
class _Equations:
    """The weighted, scaled equations of one set of lenslets: root_weight G scale = u singular vt."""

    root_weight: Floats  # (lenslet x xy,)
    scale: Floats  # of each coefficient: the prior's n^-6, or 1 without it; (pupil_mode - 1,)
    u: Floats  # (lenslet x xy, pupil_mode - 1)
    singular: Floats  # (pupil_mode - 1,), m
    vt: Floats  # (pupil_mode - 1, pupil_mode - 1)
    matrix: Floats  # G, (lenslet x xy, pupil_mode - 1)

    def inverse(self, gain: Floats) -> Floats:
        """The estimator K of one field mode with the `gain` (pupil_mode - 1,): (pupil_mode - 1, lenslet x xy)."""
        return np.asarray((self.scale[:, None] * self.vt.T * gain) @ (self.u.T * self.root_weight))


class ModalSolution:
    """The dual-orthogonal coefficients of one wavefront; what is costly is computed when it is asked for."""

    def __init__(
        self,
        *,
        coefficients: Floats,
        known: Mask,
        equations: _Equations,
        modes: PupilModes,
        gain: Floats,
        prior_variance: Floats,
        slopes: Floats,
        slope_covariance: Floats,
    ) -> None:
        self.coefficients = coefficients  # e_pq, rad, (pupil_mode, field_mode); zero for the piston
        self.known = known  # where it is known, (lenslet_row, lenslet_column); elsewhere it would be invented
        self._equations, self._modes = equations, modes
        self._gain = gain  # 1 / singular, or less where the prior holds: (pupil_mode - 1, field_mode)
        self._prior_variance = prior_variance  # s_q^2, (field_mode,); 0 without the prior
        self._slopes = slopes  # (lenslet x xy, field_mode), rad/m
        self._slope_covariance = slope_covariance  # (lenslet, field_mode, xy, field_mode, xy), (rad/m)^2

    def wavefront(self, field_modes: Floats) -> Floats:
        """Wavefront, rad, where the field modes have the values (..., field_mode); see `wavefront.Solution`."""
        phase = np.tensordot(field_modes @ self.coefficients.T, self._modes.values[:, self.known], axes=1)
        wavefront = np.full((*phase.shape[:-1], *self.known.shape), np.nan)
        wavefront[..., self.known] = phase - phase.mean(axis=-1, keepdims=True)
        return wavefront

    def sigma(self, field_modes: Floats) -> Floats:
        """Standard deviation of `wavefront`, rad, the same shape."""
        values = self._modes.values[1:, self.known]
        values = values - values.mean(axis=1, keepdims=True)
        flat = field_modes.reshape(-1, field_modes.shape[-1])
        sigma = np.full((len(flat), *self.known.shape), np.nan)
        for view, at in enumerate(flat):
            covariance = np.einsum("q,pqrs,s->pr", at, self.covariance, at, optimize=True)
            sigma[view, self.known] = np.sqrt(np.einsum("pk,pr,rk->k", values, covariance, values, optimize=True))
        return sigma.reshape(*field_modes.shape[:-1], *self.known.shape)

    @cached_property
    def coefficients_sigma(self) -> Floats:
        """Standard deviation of each coefficient, rad, (pupil_mode, field_mode); zero for the piston."""
        equations, noise = self._equations, self._slope_covariance
        pupil_modes, field_modes = self.coefficients.shape
        variance = np.zeros((pupil_modes, field_modes))
        for q in range(field_modes):
            inverse = equations.inverse(self._gain[:, q]).reshape(pupil_modes - 1, -1, 2)
            for a, b in ((0, 0), (0, 1), (1, 0), (1, 1)):
                variance[1:, q] += (inverse[..., a] * inverse[..., b]) @ noise[:, q, a, q, b]
        variance[1:] += (equations.scale[:, None] * equations.vt.T) ** 2 @ self._left_to_prior()
        return np.sqrt(variance)

    @cached_property
    def covariance(self) -> Floats:
        """Covariance of the coefficients but the piston's, rad^2: (pupil_mode - 1, field_mode, the same twice).

        What the noise of the slopes makes, and what the prior holds back: both as the estimator passes them on.
        """
        equations, noise = self._equations, self._slope_covariance
        pupil_modes, field_modes = self.coefficients.shape
        inverses = [
            equations.inverse(self._gain[:, q]).reshape(pupil_modes - 1, -1, 2).transpose(2, 0, 1)
            for q in range(field_modes)
        ]  # each (xy, pupil_mode - 1, lenslet)
        covariance = np.zeros((pupil_modes - 1, field_modes, pupil_modes - 1, field_modes))
        for q in range(field_modes):
            for r in range(q + 1):
                block = sum(
                    (inverses[q][a] * noise[:, q, a, r, b]) @ inverses[r][b].T
                    for a, b in ((0, 0), (0, 1), (1, 0), (1, 1))
                )
                covariance[:, q, :, r] = block
                covariance[:, r, :, q] = np.transpose(block)
        scaled = equations.scale[:, None] * equations.vt.T
        for q, held_back in enumerate(self._left_to_prior().T):
            covariance[:, q, :, q] += (scaled * held_back) @ scaled.T
        return covariance

    @cached_property
    def chi_square(self) -> float:
        """Reduced chi-square of the slopes against the fit: about 1 when only noise keeps them apart."""
        misfit = self._slopes - self._equations.matrix @ self.coefficients[1:]
        variance = np.einsum("lqaqa->laq", self._slope_covariance).reshape(misfit.shape)
        with np.errstate(invalid="ignore", divide="ignore"):
            total = np.sum(misfit**2 / variance)
            return float(total / (misfit.size - np.sum(self._gain * self._equations.singular[:, None])))

    def _left_to_prior(self) -> Floats:
        """Variance along the singular vectors that the data leave to the prior, (pupil_mode - 1, field_mode)."""
        return np.asarray(self._prior_variance * (1 - self._gain * self._equations.singular[:, None]) ** 2)


class ModalSolver:
    """Fits pupil modes to the slopes of the lenslets inside the pupil.

    What a set of valid lenslets and weights determines is kept as long as they do not change.
    """

    def __init__(self, modes: PupilModes, *, is_smooth: bool = False) -> None:
        """Prepare for the modes of a pupil, the piston first; `is_smooth` holds the prior against them."""
        self._modes, self._is_smooth = modes, is_smooth
        gradients = modes.gradients[1:]
        self._gradients = gradients.reshape(len(gradients), -1)  # (pupil_mode without piston, lenslet x xy), 1/m
        self._scale = modes.degree[1:] ** -_PRIOR_EXPONENT if is_smooth else np.ones(len(gradients))
        equal = np.ones((*modes.inside.shape, 2))
        self._equations(modes.inside.tobytes(), equal.tobytes())  # says at once if all lenslets cannot tell them apart

    def __call__(
        self, slopes: Floats, covariance: Floats, valid: Mask, *, weights: Floats | None = None
    ) -> ModalSolution:
        """Fit the slopes (lenslet_row, lenslet_column, field_mode, xy), rad/m, of the valid lenslets.

        `covariance` (lenslet_row, lenslet_column, field_mode, xy, field_mode, xy), (rad/m)^2, becomes that of the
        coefficients; `weights` (lenslet_row, lenslet_column, xy) say how much each slope counts, in any unit.
        """
        valid = valid & self._modes.inside
        weights = np.ones((*valid.shape, 2)) if weights is None else np.asarray(weights, np.float64)
        equations = self._equations(valid.tobytes(), weights.tobytes())
        data = np.swapaxes(slopes[valid], 1, 2).reshape(-1, slopes.shape[2])
        along = equations.u.T @ (equations.root_weight[:, None] * data)
        if self._is_smooth:
            total = np.sum((equations.root_weight[:, None] * data) ** 2, axis=0)
            ratio, noise = _likeliest(equations.singular, along, total, len(data))
            gain = ratio * equations.singular[:, None] / (1 + ratio * equations.singular[:, None] ** 2)
            prior_variance, known = ratio * noise, self._modes.inside
        else:
            gain = np.broadcast_to(1 / equations.singular[:, None], along.shape)
            prior_variance, known = np.zeros(along.shape[1]), valid
        coefficients = equations.scale[:, None] * (equations.vt.T @ (gain * along))
        return ModalSolution(
            coefficients=np.concatenate([np.zeros((1, along.shape[1])), coefficients]),
            known=known,
            equations=equations,
            modes=self._modes,
            gain=gain,
            prior_variance=prior_variance,
            slopes=data,
            slope_covariance=covariance[valid],
        )

    @lru_cache(maxsize=16)  # noqa: B019 - a solver lives as long as its reference, and so may what it remembers
    def _equations(self, valid_bytes: bytes, weight_bytes: bytes) -> _Equations:
        """Set up and decompose the equations of the valid lenslets."""
        valid = np.frombuffer(valid_bytes, np.bool_)
        chosen = np.repeat(valid, 2)
        root_weight = np.sqrt(np.frombuffer(weight_bytes, np.float64)[chosen])
        matrix = self._gradients[:, chosen].T
        modes = len(self._gradients)
        if self._is_smooth:  # fewer slopes than modes are no obstacle: rows of zeros keep the vectors complete
            missing = max(0, modes - len(matrix))
            padded = np.pad(matrix * root_weight[:, None] * self._scale, ((0, missing), (0, 0)))
            u, singular, vt = np.linalg.svd(padded, full_matrices=False)
            u = u[: len(matrix)]
        else:
            u, singular, vt = np.linalg.svd(matrix * root_weight[:, None], full_matrices=False)
            if singular.size < modes or singular[-1] < 1e-6 * singular[0]:
                raise ReconstructionError(
                    f"{np.count_nonzero(valid)} valid lenslets cannot tell {modes + 1} pupil modes apart:"
                    " lower pupil_modes, or leave it out"
                )
        return _Equations(root_weight, self._scale, u, singular, vt, matrix)


def _likeliest(singular: Floats, along: Floats, total: Floats, count: int) -> tuple[Floats, Floats]:
    """The likeliest ratio of prior to noise variance of each field mode, and the noise variance: (field_mode,) each.

    `along` (k, field_mode) are the `count` data along the singular vectors, `total` (field_mode,) their sum of
    squares. Under the prior, component k has the variance noise (1 + ratio singular_k^2), all others only noise;
    for a given ratio the likeliest noise follows in closed form, so that only the ratio is searched for.
    """
    ratios = _PRIOR_RATIOS / singular[0] ** 2
    spread = 1 + ratios[:, None] * singular**2  # (ratio, k)
    beyond = np.maximum(total - np.sum(along**2, axis=0), 0.0)
    noise = np.maximum(((1 / spread) @ along**2 + beyond) / count, np.finfo(float).tiny)  # (ratio, field_mode)
    evidence = -count / 2 * np.log(noise) - np.sum(np.log(spread), axis=1)[:, None] / 2
    best = np.argmax(evidence, axis=0)
    return ratios[best], noise[best, np.arange(noise.shape[1])]
