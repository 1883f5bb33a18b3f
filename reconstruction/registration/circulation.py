"""Test whether subimages rotate. Thin layers cannot cause this.

Straight rays through layers displace light by the gradient of a potential over the field (docs/methods.md).
A warp that may rotate also measures the remaining components, the circulation, which must vanish within their errors.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.linalg import null_space
from scipy.special import gammaincinv

from reconstruction.arrays import Floats
from reconstruction.displacement import Displacement
from reconstruction.modes.field_modes import PolynomialModes, gradient_basis

# A direction is judged if its error is at most so many times that of the best observed one: 2 - 9 for squares and
# octagons, 14 - 40 for most directions of discs.
_OBSERVABLE = 10.0
# Systematic error over the local deformation, times the ratio above: on the noise-free screens of evidence/accuracy.md
# the circulation of a square is 0.01 - 0.05 of the deformation, most at 1.25 mm and near the source.
_SYSTEMATIC_SHARE = 0.02
_SYSTEMATIC_PX = 0.01  # without the response, which knows no rotation
_ROTATING_SIGMA = 5.0  # mean rotation over its error
_ROTATING_CHI_SQUARE = 4.0  # circulation typically twice its error
_SHOWN = 0.5  # share of a rotation that must lie in the judged directions
_NOTHING = 1e-9  # share of the variance that rounding leaves in directions without any
_UNCERTAIN = 1e6  # variance over that of all other directions, of what the source hides


@dataclass(frozen=True, slots=True, eq=False)
class Circulation:
    """Rotation of the subimages, and whether it contradicts layers."""

    rotation_rad: Floats  # (lenslet_row, lenslet_column); NaN where not converged, or if the source does not show it
    rotation_sigma_rad: Floats  # standard deviation, noise only, the same shape
    mean_rad: float  # weighted mean over the lenslets; 0 if the source shows no rotation
    mean_sigma_rad: float  # noise and systematic error; infinite if the source shows no rotation
    chi_square: float  # reduced, of the circulation of a typical lenslet; 0 if the source shows none

    @property
    def is_shown(self) -> bool:
        """True if the image of the source changes when it rotates."""
        return bool(np.isfinite(self.mean_sigma_rad))

    @property
    def significance(self) -> float:
        """Mean rotation over its error."""
        return self.mean_rad / self.mean_sigma_rad

    @property
    def contradicts_layers(self) -> bool:
        """True if subimages rotate by more than the errors allow."""
        return abs(self.significance) > _ROTATING_SIGMA or self.chi_square > _ROTATING_CHI_SQUARE


def measure_circulation(displacement: Displacement, half_width_px: float) -> Circulation | None:
    """Measure the rotation of the subimages and judge their circulation.

    `half_width_px` is that of the field in a subimage. The rotation of a lenslet is the rigid one that fits its
    circulation best. Systematic errors are `_SYSTEMATIC_PX` and a share of the local deformation; lenslets have them in
    common, so that they remain in the mean. A median over the lenslets gives chi-square, so that a few bad lenslets do
    not decide.

    None if the registration excludes rotation, or leaves it out because the source hides it, or does not know how
    errors are correlated, or if no lenslet converged.
    """
    valid, modes = displacement.valid, displacement.modes
    if not isinstance(modes, PolynomialModes) or modes.count < 3 or not valid.any():
        return None
    circulation, deformation, rotation = _parts(modes)
    count = 2 * modes.count
    # Coefficients and covariance with the x modes before the y modes.
    coefficients = np.swapaxes(displacement.coefficients[valid], 1, 2).reshape(-1, count)
    covariance = displacement.covariance[valid].transpose(0, 2, 1, 4, 3).reshape(-1, count, count)
    noise = circulation @ covariance @ circulation.T
    knows_correlation = (covariance * (1 - np.eye(count))).any()
    if not knows_correlation or np.einsum("lkk->", noise) <= _NOTHING * np.einsum("lkk->", covariance):
        return None

    covariance = covariance + _hidden(covariance)
    noise = circulation @ covariance @ circulation.T
    best = np.linalg.eigvalsh(covariance)[:, :1, None]
    ratio, directions = np.linalg.eigh(np.mean(noise / np.maximum(best, np.finfo(np.float64).tiny), axis=0))
    judged, ratio = directions.T[ratio < _OBSERVABLE**2], ratio[ratio < _OBSERVABLE**2]
    found, noise = coefficients @ (judged @ circulation).T, judged @ noise @ judged.T
    deformed = np.sum((coefficients @ deformation.T) ** 2, axis=1, keepdims=True)
    systematic = _SYSTEMATIC_PX**2 + _SYSTEMATIC_SHARE**2 * ratio * deformed  # px^2, (L, direction)
    information = np.linalg.inv(noise + systematic[:, None] * np.eye(len(judged)))

    chi_square = 0.0
    if judged.size:
        squares = np.einsum("la,lab,lb->l", found, information, found)
        chi_square = float(np.median(squares) / (2 * gammaincinv(len(judged) / 2, 0.5)))
    rotation_rad, sigma_rad = np.full((2, *valid.shape), np.nan)
    rigid = judged @ rotation  # of a rotation by 1 px at the field's edge
    if rigid @ rigid < _SHOWN * rotation @ rotation:
        return Circulation(rotation_rad, sigma_rad, 0.0, np.inf, chi_square)
    estimator = information @ rigid
    estimator /= (estimator @ rigid)[:, None]
    turn_rad = np.sum(estimator * found, axis=1) / half_width_px
    variance = np.einsum("la,lab,lb->l", estimator, noise, estimator) / half_width_px**2
    systematic = np.sum(estimator**2 * systematic, axis=1) / half_width_px**2
    weight = 1 / (variance + systematic)
    weight /= weight.sum()
    mean_sigma = np.sqrt(weight**2 @ variance + (weight @ np.sqrt(systematic)) ** 2)
    rotation_rad[valid], sigma_rad[valid] = turn_rad, np.sqrt(variance)
    return Circulation(rotation_rad, sigma_rad, float(weight @ turn_rad), float(mean_sigma), chi_square)


def _hidden(covariance: Floats) -> Floats:
    """Variance of displacements left out because the source hides them, (L, 2Q, 2Q), where `covariance` is zero."""
    total = np.einsum("lkk->l", covariance)
    values, vectors = np.linalg.eigh(np.mean(covariance / total[:, None, None], axis=0))
    left_out = vectors[:, values < _NOTHING]
    return np.asarray(_UNCERTAIN * total[:, None, None] * (left_out @ left_out.T))


@lru_cache(maxsize=16)
def _parts(modes: PolynomialModes) -> tuple[Floats, Floats, Floats]:
    """Directions of displacements, with the x modes before the y modes.

    Circulation, orthonormal, no gradients of potentials, (C, 2Q); deformation, such gradients except the two
    translations, (D, 2Q); circulation of the rotation (-y, x), (C,).
    """
    gradients = gradient_basis(modes)
    circulation = null_space(gradients).T
    x, y = (grid.ravel() for grid in np.meshgrid(np.linspace(-1, 1, 9), np.linspace(-1, 1, 9)))
    to_modes = np.linalg.pinv(modes.values(x, y))
    translations = np.zeros((2, 2 * modes.count))
    translations[0, 0] = translations[1, modes.count] = 1  # T_0 is constant
    deformation = null_space(np.concatenate([circulation, translations])).T
    return circulation, deformation, circulation @ np.concatenate([-y @ to_modes, x @ to_modes])
