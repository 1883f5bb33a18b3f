"""What the Gauss-Newton steps of a warp need of the reference, computed once.

The steepest-descent images are taken from the reference instead of the frame: d(residual)/dc_q = d(I0 T_q)/dx. So
their pseudo-inverse does not depend on the frame, and a step is one product with the residual (after Baker and
Matthews 2004, International Journal of Computer Vision 56, 221). Where the camera's noise is known, each pixel counts
by the inverse of its variance: A = (J W J^T)^-1 J W.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from reconstruction.displacement import Mask
from reconstruction.field_modes import PolynomialModes
from reconstruction.geometry import Floats
from reconstruction.noise import CameraNoise
from reconstruction.spline import Image
from reconstruction.subimages import ReferenceSubimages

# What a warp may leave unexplained, over the brightest pixel of a subimage. Without it the dark surround of a bright
# subimage, where noise is weakest, would count most: there is the light that diffraction scatters, which no warp
# describes. The noise-free wavefronts of physics.md, section 7, would be 0.169 0.110 0.097 rad wrong instead of 0.098
# 0.060 0.050, and those of dim frames would not be less noisy.
_MODEL_ERROR = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class Propagated:
    """What noise of a given variance per pixel does to the fits of L lenslets with Q field modes."""

    covariance: Floats  # of the displacement coefficients, (L, Q, xy, Q, xy)
    square: Floats  # the weighted sum of its squares that is to be expected, (L,)
    fitted: Floats  # how much of that the fit follows, (L,)


@dataclass(frozen=True, slots=True, eq=False)
class Template:
    """The reference as one warp sees it: L lenslets, N pixels a window, Q field modes."""

    offset_px: Image  # positions of the pixels about the lenslet centre, in the lattice frame, (N, xy)
    light: Image  # I0, counts, (L, N)
    basis: Image  # T_q and, per pixel, its derivatives along x and y, (3, Q, N); derivatives zero without flux
    inverse: Image  # A, inverse of the steepest-descent images: x modes, y modes, gain, offset, (L, 2Q + 2, N)
    weight: Image  # of the pixels, one on average, (L, N)
    per_pixel: Propagated  # of noise with variance 1 in every pixel
    per_light: Propagated  # of noise with as much variance as there is light, as shot noise has


def prepare_template(
    reference: ReferenceSubimages,
    modes: PolynomialModes,
    pixels: Mask,
    *,
    conserve_flux: bool,
    noise: CameraNoise | None = None,
) -> Template:
    """Prepare the steps of the warp with the field modes T_q on some pixels (N,) of the windows.

    For d along x the steepest-descent images are d(I0 T_q)/dx = T_q dI0/dx + I0 dT_q/dx, of which the second term is
    the flux; those of gain and offset are I0 and 1. Without `noise` all pixels count alike.
    """
    lit, offset_px = reference.lit, reference.offset_px[pixels]
    light, gradient = reference.light[:, pixels], reference.gradient[:, pixels]
    expected = _smooth(reference)[:, pixels]
    weight = np.ones_like(light) if noise is None else _weight(expected, noise)
    x, y = offset_px.T / reference.half_width_px
    values = modes.values(x, y)
    slopes = modes.gradients(x, y) / reference.half_width_px * conserve_flux
    descent = np.concatenate(
        [
            gradient[lit, None, :, 0] * values + light[lit, None] * slopes[..., 0],
            gradient[lit, None, :, 1] * values + light[lit, None] * slopes[..., 1],
            light[lit, None],
            np.ones((np.count_nonzero(lit), 1, light.shape[1])),
        ],
        axis=1,
    )
    weighted = descent * weight[lit, None]
    norm = np.sqrt(np.einsum("lkn,lkn->lk", descent, weighted))[..., None]
    normal = weighted @ np.swapaxes(descent, 1, 2) / norm / np.swapaxes(norm, 1, 2)
    inverse = np.zeros((len(light), *descent.shape[1:]))
    inverse[lit] = np.linalg.pinv(normal, rcond=1e-9, hermitian=True) @ (weighted / norm) / norm
    leverage = np.zeros_like(light)
    leverage[lit] = np.einsum("lkn,lkn->ln", inverse[lit], descent)
    return Template(
        offset_px=offset_px.astype(np.float32),
        light=light.astype(np.float32),
        basis=np.stack([values, slopes[..., 0], slopes[..., 1]]).astype(np.float32),
        inverse=inverse.astype(np.float32),
        weight=weight.astype(np.float32),
        per_pixel=_propagate(np.ones_like(light), inverse, weight, leverage),
        per_light=_propagate(np.maximum(expected, 0), inverse, weight, leverage),
    )


def _weight(expected: Floats, noise: CameraNoise) -> Floats:
    """How much each pixel counts, one on average: the inverse square of the residual to be expected, (L, N).

    That is the noise, and what the warp cannot explain.
    """
    peak = np.maximum(expected.max(axis=1, keepdims=True), np.finfo(np.float32).tiny)
    weight = 1 / (noise.variance(expected) / peak**2 + _MODEL_ERROR**2)
    return np.asarray(weight / weight.mean(axis=1, keepdims=True))


def _propagate(variance: Floats, inverse: Floats, weight: Floats, leverage: Floats) -> Propagated:
    """Carry noise of independent pixels, (L, N), through the fit with A = `inverse` (L, 2Q + 2, N)."""
    modes = inverse.shape[1] // 2 - 1
    warp = inverse[:, : 2 * modes]
    covariance = (warp * variance[:, None]) @ np.swapaxes(warp, 1, 2)
    covariance = covariance.reshape(-1, 2, modes, 2, modes)
    return Propagated(
        covariance=np.ascontiguousarray(covariance.transpose(0, 2, 1, 4, 3)),
        square=np.sum(weight * variance, axis=1),
        fitted=np.sum(weight * variance * leverage, axis=1),
    )


def _smooth(reference: ReferenceSubimages) -> Floats:
    """The light that is expected, (L, N): of a noisy reference the mean of neighbours.

    Weights from each pixel's own light would favour those that happen to be too dark.
    """
    light = reference.light.reshape(-1, reference.width, reference.width)
    return np.asarray(ndimage.uniform_filter(light, (0, 3, 3), mode="nearest").reshape(reference.light.shape))
