"""Expected errors of one reference's displacements, in whose unit the solves work."""

import numpy as np

from reconstruction.arrays import Floats, Mask
from reconstruction.displacement import SYSTEMATIC_PX, Displacement
from reconstruction.modes.pupil_modes import PupilModes
from reconstruction.solve.sensitivity import Lenslets, Sensitivity

_ALIKE = 0.1  # share of the systematic error that all parameters have alike, if the noise is unknown
# Lenslets whose systematic errors count as one. So the error bars of single layers without noise cover 69 and 66 % of
# the errors with a checkerboard (l = 1.25, 2 mm), 63 and 74 % with a square; with 1 it was 39 to 52 %, with 9 80 to 88.
_ALIKE_LENSLETS = 4.0
_BY_CHANCE = 1.2  # noise found over that expected, below which it may be by chance
_LEAST_NOISE = 1e-6  # variance of the noise over that of the systematic error, below which the noise is unknown


class ExpectedErrors:
    """Whitens displacements: K independent numbers for each of L lenslets, with an expected variance of 1.

    Parameters
    ----------
    sensitivity : Sensitivity
        Parameters of the lenslets' warps per rad.
    parameters : (K, 2Q)
        Displacement (x modes, y modes) of each parameter, orthonormal rows.
    covariance : (lenslet_row, lenslet_column, field_mode, xy, field_mode, xy)
        Expected covariance of a frame's displacements, px^2; NaN where lost, 0 if unknown.
    inside : (lenslet_row, lenslet_column)
        Lenslets to use.
    """

    def __init__(self, sensitivity: Sensitivity, parameters: Floats, covariance: Floats, inside: Mask) -> None:
        field_modes = parameters.shape[1] // 2
        self._sensitivity = sensitivity
        # From displacements (field_mode, xy).
        self._to_parameters = parameters.reshape(-1, 2, field_modes).transpose(2, 1, 0).reshape(2 * field_modes, -1)
        expected, is_known, self.share_of_noise = _expected_covariance(covariance, self._to_parameters)
        self.is_usable = is_known & inside.ravel()  # (L,)
        self.colour = np.linalg.cholesky(expected)  # from whitened numbers to parameters, px, (L, K, K)
        self._whiten = np.linalg.inv(self.colour)

    def share(self, displacement: Displacement, weights: Floats | None = None) -> Floats:
        """Certainty of each lenslet over the expected one, (L,); 0 where lost.

        `weights` (lenslet_row, lenslet_column) are 1 by default.
        """
        used = displacement.valid.ravel() & self.is_usable
        return np.where(used, 1.0 if weights is None else weights.ravel(), 0.0)

    def whitened(self, displacement: Displacement) -> Floats:
        """Whitened displacements, (L, K); 0 where lost."""
        data = displacement.coefficients.reshape(len(self.is_usable), -1) @ self._to_parameters
        used = displacement.valid.ravel() & self.is_usable
        return np.asarray(np.matvec(self._whiten, np.where(used[:, None], data, 0.0)))

    def variance(self, noise: float, ratio: float, square: Floats) -> Floats:
        """Variance of solved components with squared singular values (n,), for the noise and prior of the evidence.

        `ratio` is that of the prior's variance to the noise; infinite without a prior. Systematic errors are alike in
        neighbouring lenslets, so that they average less than noise. The expected ones are an upper limit, which counts
        where noise is smaller; if it is unknown, all errors count as systematic.
        """
        systematic = (1 - self.share_of_noise) ** 2 * min(noise, 1.0) + max(noise - _BY_CHANCE, 0.0)
        larger = noise + (_ALIKE_LENSLETS - 1) * systematic
        return np.asarray(larger / (square + larger / (noise * ratio)))

    @property
    def response(self) -> Floats:
        """Whitened response to local wavefronts, per rad, (L, K, n, m, field_mode); 0 where unusable."""
        whitened = self._whiten * self.is_usable[:, None, None]
        per_rad = np.moveaxis(self._sensitivity.response, -1, 1)  # (lenslet or 1, K, n, m, field_mode)
        found = np.matmul(whitened, per_rad.reshape(*per_rad.shape[:2], -1))
        return np.asarray(found.reshape(*found.shape[:2], *per_rad.shape[2:]))

    def rows(self, modes: PupilModes, some: Lenslets) -> Floats:
        """Whitened displacements of some lenslets per rad, (lenslet * K, (pupil_mode - 1) * field_mode)."""
        sensitivity = self._sensitivity(modes, some)
        whitened = self._whiten[some] * self.is_usable[some, None, None]
        rows = np.matmul(whitened, sensitivity.reshape(*sensitivity.shape[:2], -1))
        return np.asarray(rows.reshape(-1, rows.shape[2]))


def _expected_covariance(covariance: Floats, to_parameters: Floats) -> tuple[Floats, Mask, float]:
    """Covariance of the parameters, (lenslet, K, K), the lenslets where it is known, and the share of the noise.

    It is that of the noise, enlarged by the systematic error; if the noise is unknown, that error alone, shared among
    the parameters as noise would be.
    """
    lenslets, columns = covariance.shape[0] * covariance.shape[1], len(to_parameters)
    covariance = covariance.reshape(lenslets, columns, columns)
    is_known = np.asarray(np.isfinite(covariance).all(axis=(1, 2)))
    of_noise = to_parameters.T @ np.where(is_known[:, None, None], covariance, 0.0) @ to_parameters
    alike = np.eye(of_noise.shape[1])
    variance = np.trace(of_noise, axis1=1, axis2=2) / len(alike)
    usual = float(np.median(variance[is_known])) if is_known.any() else 0.0
    if usual < _LEAST_NOISE * SYSTEMATIC_PX**2:
        seen = is_known & (variance > 0)
        if seen.any():  # as much more uncertain as noise would make them
            shape = np.mean(of_noise[seen] / variance[seen, None, None], axis=0)
            alike = (1 - _ALIKE) * shape + _ALIKE * alike
        return np.broadcast_to(SYSTEMATIC_PX**2 * alike, of_noise.shape), is_known, 0.0
    expected = (1 + SYSTEMATIC_PX**2 / usual) * of_noise + _LEAST_NOISE * usual * alike
    expected[~is_known] = alike
    return expected, is_known, usual / (usual + SYSTEMATIC_PX**2)
