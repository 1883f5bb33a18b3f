"""The error bars of fitted warps: what the camera's noise does to them, and to the residual.

The broad steepest-descent images see the slow part of the noise, which interpolation leaves as it is: so the covariance
is that of pixels without interpolation. The residual holds all of the noise, and so less than the pixels' own.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from reconstruction.displacement import Mask
from reconstruction.geometry import Floats
from reconstruction.lenslet_fits import Fits
from reconstruction.spline import noise_power
from reconstruction.subimages import ReferenceSubimages
from reconstruction.template import Propagated, Template


class Errors(NamedTuple):
    """How wrong the fits of L lenslets may be."""

    covariance: Floats  # px^2, (L, Q, xy, Q, xy); without known noise, of what the warp cannot explain
    chi_square: Floats  # reduced, (L,); NaN where the noise is not known
    unexplained: Floats  # weighted sum of squares of the residual, less what noise leaves in it, counts^2, (L,)
    known: Floats  # share of what a lenslet's pixels say about its parameters that the good ones say, (L,)


class FitErrors:
    """Propagates noise through the fits against one reference."""

    def __init__(self, reference: ReferenceSubimages, template: Template, pixels: Mask) -> None:
        """Prepare for a template on some pixels (N,) of the reference's windows."""
        self._noise, self._template = reference.noise, template
        self._of_reference = 1 / reference.reference_frames
        # Interpolation has weakened the noise of the reference, too: of uniform noise, of shot noise, (L, 2).
        power = noise_power(reference.position_px[:, pixels])
        weight = np.stack([template.grid.weight, template.grid.weight * np.maximum(template.grid.light, 0)], axis=-1)
        total = np.maximum(weight.sum(axis=1), np.finfo(np.float32).tiny)
        self._reference_power = np.einsum("ln,lnk->lk", power, weight) / total

    @property
    def expected_square(self) -> Floats:
        """Weighted sum of the squares of all noise, as a polynomial of the gain: (L, 3); zero where it is not known."""
        square = np.zeros((len(self._template.contrast), 3))
        if self._noise is not None:
            shot = self._noise.counts_per_light * self._template.per_light.square
            read = self._noise.read_noise_counts**2 * self._template.per_pixel.square
            square[:, 0], square[:, 1], square[:, 2] = (shot + read) * self._of_reference, shot, read
        return square

    def __call__(self, fits: Fits) -> Errors:
        """Say how wrong the fits are; of those that ran away it may say anything."""
        per_pixel, per_light, known = self._template.per_pixel, self._template.per_light, np.ones(len(fits.gain))
        careful = np.flatnonzero(fits.careful)
        if careful.size:
            of_pixel, of_light, known[careful] = self._template.without(careful, fits.masked[careful])
            per_pixel, per_light = _with(per_pixel, careful, of_pixel), _with(per_light, careful, of_light)
        power_pixel, power_light = fits.noise_power.T
        with np.errstate(all="ignore"):
            if self._noise is None:
                variance = fits.square / (power_pixel * per_pixel.square - per_pixel.fitted)
                return Errors(
                    _scaled(per_pixel.covariance, variance), np.full_like(variance, np.nan), fits.square, known
                )
            # Of the frame, raised by the gain to the brightness of the reference, and of the reference itself.
            shot, read = self._noise.counts_per_light, self._noise.read_noise_counts**2
            shot_frame, read_frame = shot * fits.gain, read * fits.gain**2
            shot_reference, read_reference = shot * self._of_reference, read * self._of_reference
            covariance = _scaled(per_light.covariance, shot_frame + shot_reference)
            covariance += _scaled(per_pixel.covariance, read_frame + read_reference)
            still_pixel, still_light = self._reference_power.T
            expected = shot_frame * (power_light * per_light.square - per_light.fitted)
            expected += read_frame * (power_pixel * per_pixel.square - per_pixel.fitted)
            expected += shot_reference * (still_light * per_light.square - per_light.fitted)
            expected += read_reference * (still_pixel * per_pixel.square - per_pixel.fitted)
            return Errors(covariance, fits.square / expected, fits.square - expected, known)


def _scaled(covariance: Floats, factor: Floats) -> Floats:
    return np.asarray(covariance * factor[:, None, None, None, None])


def _with(every: Propagated, lenslets: NDArray[np.intp], some: Propagated) -> Propagated:
    """Replace what is known of some lenslets (K,)."""
    covariance, square, fitted = every.covariance.copy(), every.square.copy(), every.fitted.copy()
    covariance[lenslets], square[lenslets], fitted[lenslets] = some.covariance, some.square, some.fitted
    return replace(every, covariance=covariance, square=square, fitted=fitted)
