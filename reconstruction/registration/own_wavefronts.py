"""Coma and trefoil that each lenslet has of its own, from its subimage of the reference.

Their blur is not symmetric, so it shows how large they are, and with which sign. A symmetric blur, as that of defocus,
shows only the size of its cause. What all lenslets have alike counts as the shape of the source.
"""

from typing import NamedTuple

import numpy as np

from reconstruction.arrays import Floats
from reconstruction.displacement import TRANSMISSION_MODES
from reconstruction.frame.spline import interpolate, mean_interpolation
from reconstruction.registration.subimages import LensletModel, ReferenceSubimages

OWN_WAVEFRONTS = [(n, 3 - n) for n in range(4)]  # (n, m) of P_m(xi) P_n(eta)
_LEAST_LENSLETS = 16  # that tell how large own wavefronts usually are; with 4 of them, noise made errors larger
_ALIGNMENTS = 2
_SQUARE_OVER_MEDIAN = 2.2  # mean square over the median of the squares, if normally distributed


class OwnWavefront(NamedTuple):
    """A small wavefront that the lenslets have of their own, and what a rad of it does to subimages."""

    rad: Floats  # of each lenslet, (L,)
    image: Floats  # change of a subimage per rad, (row, column)
    changes: Floats  # change of what a sample changes, per rad of the lenslet and of the sample, (..., row, column)


class OwnWavefronts(NamedTuple):
    """Own wavefronts `OWN_WAVEFRONTS` of the lenslets, less their mean."""

    rad: Floats  # (wavefront, L); 0 where the lenslet is dark, or few are lit
    images: Floats  # changes of the model's image per rad, (wavefront, row, column)


def own_wavefronts(reference: ReferenceSubimages, model: LensletModel) -> OwnWavefronts:
    """Find the own wavefronts that a reference shows, with a model of its lenslets."""
    points = len(model.position)
    changes = model.derivatives(3, np.ones((1, points)), np.zeros((1, points, 2)))
    images = np.stack([changes[n, m, 0] for n, m in OWN_WAVEFRONTS])
    rad, lit = np.zeros((len(images), reference.lit.size)), reference.lit
    if np.count_nonzero(lit) >= _LEAST_LENSLETS:
        rad[:, lit] = [shrunk(*each) for each in zip(*_fitted(reference, images), strict=True)]
    return OwnWavefronts(rad, images)


def _fitted(reference: ReferenceSubimages, images: Floats) -> tuple[Floats, Floats]:
    """Own wavefronts of the lit lenslets and their variance by noise, (wavefront, lit lenslet).

    A subimage differs from the mean one by them and by what is no wavefront: displacement, offset, and brightness that
    varies over the field. The subimages are aligned first: a displacement of a pixel would look like coma, and blur
    the mean.
    """
    blur, _ = mean_interpolation(reference.width)
    own_images = (blur @ images @ blur.T).reshape(len(images), -1)
    brightness = TRANSMISSION_MODES.values(*reference.offset_px.T / reference.half_width_px)
    edge = np.array(reference.spline_coefficients.shape[::-1]) - 1
    light, moved_px = reference.light[reference.lit], np.zeros(2)
    for alignment in range(_ALIGNMENTS + 1):
        mean = np.sum(light, axis=0) / np.sum(light)
        along_y, along_x = (part.ravel() for part in np.gradient(mean.reshape(reference.width, -1)))
        differences = np.stack([*mean * brightness, along_x, along_y, np.full_like(mean, mean.mean()), *own_images])
        fit = np.linalg.pinv(differences)  # (pixel, number)
        fitted = light @ fit
        gain, shift = fitted[:, :1], fitted[:, len(brightness) :][:, :2]
        if alignment < _ALIGNMENTS:
            moved_px = moved_px - shift / gain
            position_px = reference.position_px[reference.lit] + (moved_px @ reference.turn)[:, None]
            light, _ = interpolate(reference.spline_coefficients, np.clip(position_px, 0, edge))
    variance = (light - fitted @ differences) ** 2 @ fit**2
    return (fitted / gain)[:, -len(images) :].T, (variance / gain**2)[:, -len(images) :].T


def shrunk(values: Floats, variance: Floats) -> Floats:
    """Shrink measured values (n,), which scatter about 0, towards 0 according to their variance (n,).

    How much the true values scatter follows from the median of the measured squares, which bears outliers.
    """
    scatter = max(_SQUARE_OVER_MEDIAN * float(np.median(values**2)) - float(np.median(variance)), 0.0)
    return values * (scatter / np.maximum(scatter + variance, np.finfo(np.float64).tiny))
