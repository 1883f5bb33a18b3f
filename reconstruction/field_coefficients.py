"""Coefficients of a modal wavefront over the field, e_p(x, y), and as double Zernikes.

All modes are polynomials, so that a change of their basis is exact; the covariance of e_pq gives the errors.
"""

import math
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.polynomial import legendre as series
from numpy.typing import ArrayLike

from reconstruction.arrays import Booleans, Floats
from reconstruction.errors import ReconstructionError
from reconstruction.geometry import Sensor
from reconstruction.modes.field_modes import FieldModes, SampledModes
from reconstruction.modes.polynomials import number_up_to, zernike_projection
from reconstruction.modes.pupil_modes import ROUNDING_SHARE, PupilModes, pupil_modes
from reconstruction.settings import PupilBasis
from reconstruction.solve.modal import ModalSolution
from reconstruction.wavefront import Wavefront


@dataclass(frozen=True, slots=True, eq=False)
class ModalFit:
    """Coefficients e_pq of a wavefront, with what they belong to."""

    sensor: Sensor
    modes: PupilModes
    field_modes: FieldModes
    rad: Floats  # (pupil_mode, field_mode); zero for the piston
    root_covariance: Floats  # rad, (pupil_mode - 1, field_mode, n)
    known: Booleans  # where the wavefront is known, (lenslet_row, lenslet_column)

    @classmethod
    def of(cls, wavefront: Wavefront) -> Self:
        """Take the fit of a modal wavefront; fit Zernike modes to a zonal one at the lenslet centres."""
        solution, displacement = wavefront.solution, wavefront.displacement
        if not isinstance(solution, ModalSolution):
            by_mode = solution.wavefront(np.eye(displacement.modes.count))
            return cls.fitted(wavefront.sensor, displacement.modes, by_mode)
        rad, root = solution.coefficients, np.asarray(solution.root_covariance, np.float64)
        return cls(wavefront.sensor, solution.modes, displacement.modes, rad, root, solution.known)

    @classmethod
    def fitted(cls, sensor: Sensor, field_modes: FieldModes, by_mode: Floats) -> Self:
        """Fit Zernike modes to the wavefront of each field mode, rad, (field_mode, lenslet_row, lenslet_column).

        It is NaN where unknown. The errors of the coefficients are unknown.
        """
        known = np.asarray(np.isfinite(by_mode).all(axis=0))
        modes, fit = fit_at_lenslets(sensor, "zernike", known)
        rad = fit @ np.nan_to_num(by_mode.reshape(len(by_mode), -1)).T
        rad[0] = 0.0
        return cls(sensor, modes, field_modes, rad, np.full((*rad[1:].shape, 1), np.nan), known)


_MOST_MODES = 36  # of a fit at the lenslet centres: all up to degree 7


def fit_at_lenslets(sensor: Sensor, basis: PupilBasis, known: Booleans) -> tuple[PupilModes, Floats]:
    """Fit modes to wavefronts at the known lenslets (lenslet_row, lenslet_column) in the pupil.

    Returns modes and the matrix (pupil_mode, lenslet) from wavefronts to coefficients; zero for lenslets without use.
    """
    least = min(sensor.lenslets)
    modes = pupil_modes(sensor, basis, min(_MOST_MODES, number_up_to(least - 1)))
    used = (known & modes.inside).ravel()
    fit = np.full((len(modes.values), used.size), 0.0 if used.any() else np.nan)
    fit[:, used] = np.linalg.pinv(modes.values.reshape(len(fit), -1)[:, used].T)
    return modes, fit


@dataclass(frozen=True, slots=True, eq=False)
class FieldCoefficients:
    """Coefficients of a wavefront at every field position, in modes of the pupil, piston first and zero."""

    basis: PupilBasis
    rad: Floats  # in products with the field modes, (mode, field_mode)
    covariance: Floats  # between the field modes of each mode, rad^2, (mode, field_mode, field_mode)
    field_modes: FieldModes
    known_share: float  # of the lenslets inside the pupil, at which the wavefront is known

    def at(self, x: ArrayLike, y: ArrayLike) -> Floats:
        """Coefficients at normalised field positions x and y (...), broadcast together, rad, (mode, ...)."""
        return np.tensordot(self.rad, self.field_modes.values(x, y), axes=1)

    def sigma(self, x: ArrayLike, y: ArrayLike) -> Floats:
        """Standard deviations of `at`, rad, the same shape."""
        values = self.field_modes.values(x, y)
        products = values[:, None] * values[None]
        return np.sqrt(np.maximum(np.tensordot(self.covariance, products, axes=((1, 2), (0, 1))), 0))

    @property
    def field_order(self) -> int:
        """Highest radial order of the field's Zernike polynomials that the field modes contain."""
        parts = np.abs(_field_projection(self.field_modes, _degree(self.field_modes))).max(axis=1)
        count = int(np.flatnonzero(parts > ROUNDING_SHARE * parts.max())[-1]) + 1
        return math.ceil((math.sqrt(8 * count + 1) - 3) / 2)  # lowest degree up to which there are as many

    def double_zernikes(self, field_order: int | None = None) -> tuple[Floats, Floats]:
        """Double Zernike coefficients and their standard deviations.

        The circles are that inscribed in the field and that of the pupil, which may be an annulus. GalSim's convention:
        wavefront = sum_kj d[k, j] Z_k(field) Z_j(pupil), k and j as Noll counts, from 1; the row k = 0 and the column
        j = 0 are unused, and zero. Both are (k, j), rad. The highest radial order over the field is by default that of
        the field modes, which is exact.
        `ReconstructionError` if the coefficients are not those of Zernike modes, or the field modes have no such order.
        """
        if self.basis != "zernike":
            raise ReconstructionError("double Zernikes are made of Zernike modes, not of Legendre modes")
        highest = self.field_order
        order = highest if field_order is None else field_order
        if order > highest:
            raise ReconstructionError(
                f"field order {order} exceeds that of the {self.field_modes.count} field modes, {highest}: use a higher"
                " warp, or less"
            )
        onto = _field_projection(self.field_modes, order)
        rad, sigma = np.zeros((2, len(onto) + 1, len(self.rad) + 1))
        rad[1:, 1:] = onto @ self.rad.T
        sigma[1:, 1:] = np.sqrt(np.maximum(np.einsum("kq,jqr,kr->kj", onto, self.covariance, onto, optimize=True), 0))
        return rad, sigma


def fit_coefficients(fit: ModalFit, basis: PupilBasis, degree: int | None = None) -> FieldCoefficients:
    """Express a modal fit in Zernike or Legendre modes.

    Zernike modes have unit RMS over the circle or annulus of the pupil, in Noll's order; Legendre modes, over the
    lattice, are those of `modes.legendre`. The highest `degree` is by default that of the fit, which is exact.
    `ReconstructionError` if there is no such basis, the fit has no such degree, or no lenslet in the pupil is known.
    """
    highest = int(fit.modes.degree.max())
    degree = highest if degree is None else degree
    if not 1 <= degree <= highest:
        raise ReconstructionError(
            f"degree {degree} of the pupil modes must be 1 ... {highest}, that of the {len(fit.rad)} fitted modes"
        )
    inside = pupil_modes(fit.sensor, basis, 1).inside
    known_share = float(np.mean(fit.known[inside])) if inside.any() else 0.0
    if not known_share:
        raise ReconstructionError(f"no lenslet is known inside the {fit.sensor.circle.in_words}")
    onto = _pupil_projection(fit.modes, fit.sensor, basis)[: number_up_to(degree)]
    onto[0] = 0.0  # a wavefront has no piston
    root = np.tensordot(onto[:, 1:], fit.root_covariance, axes=1)
    return FieldCoefficients(basis, onto @ fit.rad, root @ np.swapaxes(root, 1, 2), fit.field_modes, known_share)


def _pupil_projection(modes: PupilModes, sensor: Sensor, basis: PupilBasis) -> Floats:
    """Coefficients of the pupil modes in those of a basis, (mode, pupil_mode); exact."""
    highest = modes.products.shape[1] - 1
    if basis != "zernike":
        onto = pupil_modes(sensor, basis, number_up_to(highest))
        flat, fitted = (each.products.reshape(len(each.degree), -1).T for each in (onto, modes))
        return np.asarray(np.linalg.lstsq(flat, fitted)[0])
    # Products of Legendre polynomials grow by 10,000 in the corners around the circle, which costs these digits.
    circle, (half_x_m, half_y_m) = sensor.circle, sensor.pupil_half_width_m
    radius_m = circle.radius_m or 0.0

    def values(x: Floats, y: Floats) -> Floats:
        at_m = (x * radius_m + circle.center_x_m) / half_x_m, (y * radius_m + circle.center_y_m) / half_y_m
        along_x, along_y = (series.legvander(at, highest) for at in at_m)
        return np.asarray(np.einsum("pnm,...n,...m->p...", modes.products, along_y, along_x, optimize=True))

    return zernike_projection(values, highest, number_up_to(highest), circle.obscuration)


def _field_projection(modes: FieldModes, order: int) -> Floats:
    """Coefficients of the field modes in Zernike modes over the inscribed circle, (mode, field_mode)."""
    return zernike_projection(modes.values, _degree(modes), number_up_to(order))


def _degree(modes: FieldModes) -> int:
    """Highest degree of the field modes."""
    if isinstance(modes, SampledModes):
        return modes.x.size + modes.y.size - 2
    return int(modes.degree.max())
