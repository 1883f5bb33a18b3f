"""Error bars of fitted warps, from the camera's noise.

Steepest-descent images see the slow part of the noise, which interpolation preserves: the covariance is that of pixels
without interpolation. The residual holds all of the noise, reduced by interpolation.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import Floats, Mask
from reconstruction.frame.spline import noise_power
from reconstruction.registration.gauss_newton.lenslet_fits import Fits
from reconstruction.registration.gauss_newton.template import Propagated, Template, coefficient_covariance
from reconstruction.registration.subimages import ReferenceSubimages
from reconstruction.runtime.compilation import compiled


@dataclass(frozen=True, slots=True, eq=False)
class FitCovariance:
    """Covariance of the coefficients of fits: noise variances times what the fits make of them."""

    variance: Floats  # of every pixel, counts^2, and per count of light, counts; (lenslet_row, lenslet_column, 2)
    per_pixel: Floats  # covariance of the parameters for a variance of 1 in every pixel, (L, P, P)
    per_light: Floats  # the same for one that is the light
    traces: Floats  # of both, (2, L)
    basis: Floats  # coefficients (x modes, y modes) of the parameters, (P, 2Q)

    def kept(self, lenslets: Mask) -> Self:
        """The same, lost for all but some lenslets (L,)."""
        return replace(self, variance=np.where(lenslets.reshape(*self.variance.shape[:2], 1), self.variance, np.nan))

    def covariance(self) -> Floats:
        """The covariance, px^2, (lenslet_row, lenslet_column, field_mode, xy, field_mode, xy)."""
        of_pixels, of_light = self.variance.reshape(-1, 2, 1, 1).swapaxes(0, 1)
        covariance = coefficient_covariance(of_pixels * self.per_pixel + of_light * self.per_light, self.basis)
        return covariance.reshape(*self.variance.shape[:2], *covariance.shape[1:])

    def trace(self) -> Floats:
        """Sum of the variances, px^2, (lenslet_row, lenslet_column); the basis is orthonormal."""
        of_pixels, of_light = self.traces.reshape(2, *self.variance.shape[:2])
        return np.asarray(self.variance[..., 0] * of_pixels + self.variance[..., 1] * of_light)


class FitErrors(NamedTuple):
    """Errors of the fits of L lenslets."""

    covariance: FitCovariance  # from the residual if the noise is unknown
    chi_square: Floats  # reduced, (L,); NaN if the noise is unknown
    unexplained: Floats  # weighted sum of squares of the residual minus its noise, counts^2, (L,)
    known: Floats  # share of the information of a lenslet's pixels in the usable ones, (L,)


class ErrorPropagation:
    """Propagates noise through the fits against one reference."""

    def __init__(self, reference: ReferenceSubimages, template: Template, pixels: Mask) -> None:
        """Prepare for a template on some pixels (N,) of the reference's windows."""
        self._noise, self._template, self._lattice = reference.noise, template, reference.lenslets
        self._basis = template.grid.basis.astype(np.float64)
        self._of_reference = 1 / reference.reference_frames
        # Share of the noise of the reference that interpolation leaves: uniform, shot, (L, 2).
        power = noise_power(reference.position_px[:, pixels])
        weight = np.stack([template.grid.weight, template.grid.weight * np.maximum(template.grid.light, 0)], axis=-1)
        total = np.maximum(weight.sum(axis=1), np.finfo(np.float32).tiny)
        self._reference_power = np.einsum("ln,lnk->lk", power, weight) / total

    @property
    def expected_square(self) -> Floats:
        """Expected weighted sum of squared noise, as a polynomial of the gain: (L, 3); zero if unknown."""
        square = np.zeros((len(self._template.contrast), 3))
        if self._noise is not None:
            shot = self._noise.counts_per_light * self._template.per_light.square
            read = self._noise.read_noise_counts**2 * self._template.per_pixel.square
            square[:, 0], square[:, 1], square[:, 2] = (shot + read) * self._of_reference, shot, read
        return square

    @property
    def expected_sigma_px(self) -> Floats:
        """RMS standard error of the parameters in a frame as bright as the reference, (L,); 0 if unknown."""
        if self._noise is None:
            return np.zeros(len(self._template.contrast))
        shot = self._noise.counts_per_light * self._template.per_light.trace
        read = self._noise.read_noise_counts**2 * self._template.per_pixel.trace
        return np.asarray(np.sqrt((shot + read) / self._template.grid.basis.shape[0]))

    def __call__(self, fits: Fits) -> FitErrors:
        """Errors of the fits; arbitrary for lost ones."""
        template, lenslets = self._template, len(fits.gain)
        variance, known = np.empty((lenslets, 2)), np.ones(lenslets)
        of_residual = np.empty(lenslets), np.empty(lenslets)
        noise = (np.nan, np.nan)
        if self._noise is not None:
            noise = self._noise.counts_per_light, self._noise.read_noise_counts**2
        prepared = *noise, self._of_reference, self._reference_power, variance, *of_residual
        per_pixel, per_light = template.per_pixel, template.per_light
        _propagate(fits, np.arange(lenslets), per_pixel, per_light, *prepared)
        covariances = per_pixel.covariance, per_light.covariance
        traces = np.stack([per_pixel.trace, per_light.trace])
        partial = np.flatnonzero(fits.is_partial)
        if partial.size:
            per_pixel, per_light, known[partial] = template.without(partial, fits.excluded[partial])
            _propagate(fits, partial, per_pixel, per_light, *prepared)
            covariances = covariances[0].copy(), covariances[1].copy()
            covariances[0][partial], covariances[1][partial] = per_pixel.covariance, per_light.covariance
            traces[:, partial] = per_pixel.trace, per_light.trace
        covariance = FitCovariance(variance.reshape(*self._lattice, 2), *covariances, traces, self._basis)
        return FitErrors(covariance, *of_residual, known)


@compiled
def _propagate(  # noqa: PLR0913, PLR0917 - compiled code takes its arguments by their place
    fits: Fits,
    lenslets: NDArray[np.intp],
    per_pixel: Propagated,
    per_light: Propagated,
    shot: float,
    read: float,
    of_reference: float,
    reference_power: Floats,
    variance: Floats,
    chi_square: Floats,
    unexplained: Floats,
) -> None:
    """Fill in noise variances (L, 2), reduced chi-squares and unexplained squares (L,) of some lenslets (K,).

    `shot` (counts^2 per count of light) and `read` (counts^2) are NaN if unknown; the reference has the share
    `of_reference` of them, reduced by interpolation to `reference_power` (L, 2).
    """
    for k in range(lenslets.size):
        lenslet = lenslets[k]
        gain, square, power = fits.gain[lenslet], fits.square[lenslet], fits.noise_power[lenslet]
        still = reference_power[lenslet]
        of_pixels, of_light, expected = 0.0, 0.0, 0.0
        if np.isnan(shot):
            of_pixels = square / (power[0] * per_pixel.square[k] - per_pixel.fitted[k])
            chi_square[lenslet] = np.nan
        else:
            # Noise of the frame, scaled to the brightness of the reference, and of the reference.
            shot_frame, read_frame = shot * gain, read * gain * gain
            shot_reference, read_reference = shot * of_reference, read * of_reference
            of_pixels, of_light = read_frame + read_reference, shot_frame + shot_reference
            left_pixels = read_frame * power[0] + read_reference * still[0]
            left_light = shot_frame * power[1] + shot_reference * still[1]
            expected = left_pixels * per_pixel.square[k] - of_pixels * per_pixel.fitted[k]
            expected += left_light * per_light.square[k] - of_light * per_light.fitted[k]
            chi_square[lenslet] = square / expected
        unexplained[lenslet] = square - expected
        variance[lenslet, 0], variance[lenslet, 1] = of_pixels, of_light
