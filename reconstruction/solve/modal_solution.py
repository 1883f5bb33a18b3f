"""Wavefront and error bars of the modal reconstruction, evaluated on request."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np
from scipy import ndimage

from reconstruction.arrays import Floats, Image, Mask
from reconstruction.displacement import Displacement
from reconstruction.modes.pupil_modes import PupilModes
from reconstruction.runtime.deferred import Deferred


@dataclass(frozen=True, slots=True, eq=False)
class KnownModes:
    """Pupil modes where the wavefront is known."""

    modes: PupilModes
    lenslets: Mask  # (lenslet_row, lenslet_column)
    values: Floats  # of the modes there, minus their means, (pupil_mode - 1, known lenslet)


def known_modes(modes: PupilModes, used: Mask, *, extrapolate: bool) -> KnownModes:
    """Modes at the lenslets used, and if a prior bridges lost ones at their neighbours, too."""
    if extrapolate:
        used = modes.inside & ndimage.binary_dilation(used, structure=np.ones((3, 3), np.bool_))
    values = modes.values[1:, used]
    values -= values.mean(axis=1, keepdims=True) if used.any() else 0.0
    return KnownModes(modes, used, values)


@dataclass(frozen=True, eq=False)
class ModalSolution:
    """Dual-orthogonal coefficients of one wavefront; error bars are computed on request."""

    coefficients: Floats  # e_pq, rad, (pupil_mode, field_mode); zero for the piston
    _known: KnownModes
    _root_covariance: Deferred[Image]
    _freedom: float  # number of data minus that of the components which they determine
    _displacement: Displacement
    _parameters: Floats  # (K, 2Q)
    _fitted: Deferred[Floats]  # parameters of the fit, px, (lenslet, K)

    def extended(self, known: KnownModes) -> Self:
        """The same wavefront in more pupil modes, known at the same lenslets; the coefficients of the others are 0."""
        more = len(known.modes.degree) - len(self.coefficients)
        return replace(
            self,
            coefficients=np.pad(self.coefficients, ((0, more), (0, 0))),
            _known=known,
            _root_covariance=Deferred(lambda: np.pad(self.root_covariance, ((0, more), (0, 0), (0, 0)))),
        )

    @property
    def modes(self) -> PupilModes:
        """The pupil modes."""
        return self._known.modes

    @property
    def known(self) -> Mask:
        """Lenslets at which the wavefront is known, (lenslet_row, lenslet_column)."""
        return self._known.lenslets

    def wavefront(self, field_modes: Floats) -> Floats:
        """Wavefront, rad, for values (..., field_mode) of the field modes; see `wavefront.Solution`."""
        phase = field_modes @ (self.coefficients[1:].T @ self._known.values)
        if phase.shape[-1] == self.known.size:
            return phase.reshape(*phase.shape[:-1], *self.known.shape)
        wavefront = np.full((*phase.shape[:-1], *self.known.shape), np.nan)
        wavefront[..., self.known] = phase
        return wavefront

    def sigma(self, field_modes: Floats) -> Floats:
        """Standard deviation of `wavefront`, rad, the same shape."""
        flat = field_modes.reshape(-1, field_modes.shape[-1])
        sigma = np.array([np.linalg.norm(self.deviations(at), axis=-1) for at in flat], np.float64)
        return sigma.reshape(*field_modes.shape[:-1], *self.known.shape)

    def deviations(self, field_modes: Floats) -> Image:
        """Independent deviations of `wavefront`, each one standard deviation, for one field position.

        From field modes (field_mode,) to rad, (lenslet_row, lenslet_column, n); their squares add to the variance.
        """
        deviations = np.full((*self.known.shape, self.root_covariance.shape[2]), np.nan, np.float32)
        at = field_modes.astype(np.float32) @ self.root_covariance
        deviations[self.known] = self._known.values.T.astype(np.float32) @ at
        return deviations

    @cached_property
    def coefficients_sigma(self) -> Floats:
        """Standard deviation of each coefficient, rad, (pupil_mode, field_mode); zero for the piston."""
        sigma = np.zeros_like(self.coefficients)
        sigma[1:] = np.linalg.norm(self.root_covariance, axis=-1)
        return sigma

    @property
    def covariance(self) -> Floats:
        """Covariance of the coefficients, rad^2, (pupil_mode - 1, field_mode) twice; without the piston.

        It includes the noise of the displacements and what the prior suppresses.
        """
        shape = self.root_covariance.shape[:2]
        flat = self.root_covariance.reshape(-1, self.root_covariance.shape[2]).astype(np.float64)
        return (flat @ flat.T).reshape(*shape, *shape)

    @property
    def displacement(self) -> Floats:
        """Displacements that the registration finds for this wavefront, px, (row, column, field_mode, xy)."""
        fitted = (self._fitted() @ self._parameters).reshape(*self.known.shape, 2, -1)
        return np.swapaxes(fitted, 2, 3)

    @cached_property
    def misfit(self) -> Floats:
        """Displacements minus those of the fit, px, (lenslet_row, lenslet_column, field_mode, xy); NaN where lost."""
        return self._displacement.coefficients - self.displacement

    @cached_property
    def chi_square(self) -> float:
        """Reduced chi-square of the displacements about the fit: about 1 if the misfit is noise."""
        lenslets, valid = self._displacement.valid.size, self._displacement.valid.ravel() & self.known.ravel()
        misfit = np.swapaxes(self.misfit, 2, 3).reshape(lenslets, -1)[valid] @ self._parameters.T
        covariance = self._displacement.covariance.reshape(lenslets, *self.misfit.shape[2:], *self.misfit.shape[2:])
        covariance = covariance[valid].transpose(0, 2, 1, 4, 3).reshape(len(misfit), *2 * self._parameters.shape[1:])
        variance = np.einsum("ka,lab,kb->lk", self._parameters, covariance, self._parameters, optimize=True)
        with np.errstate(invalid="ignore", divide="ignore"):
            return float(np.sum(misfit**2 / variance) / self._freedom)

    @property
    def root_covariance(self) -> Image:
        """Square root of `covariance`, rad, (pupil_mode - 1, field_mode, n)."""
        return self._root_covariance()
