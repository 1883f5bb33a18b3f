"""What the Gauss-Newton steps of a warp need of the reference, computed once.

The steepest-descent images are taken from the reference instead of the frame: d(residual)/dc_q = d(I0 T_q)/dx. So
their pseudo-inverse does not depend on the frame, and a step is one product with the residual (after Baker and
Matthews 2004, International Journal of Computer Vision 56, 221). Where the camera's noise is known, each pixel counts
by the inverse of its variance: A = (J W J^T)^-1 J W.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from reconstruction.arrays import Floats, Image, Mask
from reconstruction.frame.noise import CameraNoise
from reconstruction.geometry import require
from reconstruction.modes.field_modes import PolynomialModes, gradient_basis
from reconstruction.registration.gauss_newton.alignment import Grid
from reconstruction.registration.gauss_newton.warped_sampling import MONOMIALS
from reconstruction.registration.subimages import ReferenceSubimages

# What a warp may leave unexplained, over the brightest pixel of a subimage. Without it the dark surround of a bright
# subimage, where noise is weakest, would count most: there is the light that diffraction scatters, which no warp
# describes. The noise-free wavefronts of physics.md, section 7, would be 0.169 0.110 0.097 rad wrong instead of 0.098
# 0.060 0.050, and those of dim frames would not be less noisy.
_MODEL_ERROR = 0.1
_NOTHING = 1e-12
_AT_ONCE = 64  # lenslets whose numbers fit into the processor's cache


class Propagated(NamedTuple):
    """What noise of a given variance per pixel does to the fits of L lenslets with Q field modes."""

    covariance: Floats  # of the displacement coefficients, (L, Q, xy, Q, xy)
    square: Floats  # the weighted sum of its squares that is to be expected, (L,)
    fitted: Floats  # how much of that the fit follows, (L,)

    def put(self, lenslets: slice, some: Propagated) -> None:
        """Fill in what is known of some lenslets."""
        self.covariance[lenslets], self.square[lenslets], self.fitted[lenslets] = (
            some.covariance,
            some.square,
            some.fitted,
        )


@dataclass(frozen=True, slots=True, eq=False)
class Template:
    """The reference as one warp sees it: L lenslets, N pixels a window, Q field modes, P parameters."""

    grid: Grid  # what the steps need
    contrast: Floats  # standard deviation of the light, counts, (L,)
    per_pixel: Propagated  # of noise with variance 1 in every pixel
    per_light: Propagated  # of noise with as much variance as there is light, as shot noise has

    def without(self, lenslets: NDArray[np.intp], excluded: Mask) -> tuple[Propagated, Propagated, Floats]:
        """`per_pixel` and `per_light` of some lenslets (K,) when pixels `excluded` (K, N) do not count.

        Also the share of what all pixels know about the parameters that is left, (K,).
        """
        inverse, descent = (np.asarray(part[lenslets], np.float64) for part in (self.grid.inverse, self.grid.descent))
        inverse *= ~excluded[:, None]
        left = inverse @ np.swapaxes(descent, 1, 2)
        share = np.clip(np.trace(left, axis1=1, axis2=2) / left.shape[1], 0, 1)
        left[share < _NOTHING] = np.eye(left.shape[1])
        inverse = np.linalg.pinv(left) @ inverse
        weight = np.asarray(self.grid.weight[lenslets], np.float64)
        whole = weight.sum(axis=1, keepdims=True)
        weight *= ~excluded
        weight *= whole / np.maximum(weight.sum(axis=1, keepdims=True), _NOTHING)
        light = np.maximum(self.grid.light[lenslets], 0)
        basis = np.asarray(self.grid.basis, np.float64)
        return *(_propagated(v, inverse, weight, descent, basis) for v in (np.ones_like(light), light)), share


def prepare_template(
    reference: ReferenceSubimages,
    modes: PolynomialModes,
    pixels: Mask,
    *,
    conserve_flux: bool,
    rotation: bool = True,
    noise: CameraNoise | None = None,
) -> Template:
    """Prepare the steps of the warp with the field modes T_q on some pixels (N,) of the windows.

    For d along x the steepest-descent images are d(I0 T_q)/dx = T_q dI0/dx + I0 dT_q/dx, of which the second term is
    the flux; those of gain and offset are I0 and 1. Without `noise` all pixels count alike. Without `rotation` the
    displacement is the gradient of a potential over the field, as layers make it.
    """
    u, v = reference.offset_px[pixels].T / reference.half_width_px
    values = modes.values(u, v)
    slopes = modes.gradients(u, v) / reference.half_width_px * conserve_flux
    flux = 1 / reference.half_width_px if conserve_flux else 0.0
    basis = np.eye(2 * modes.count) if rotation else gradient_basis(modes)
    lenslets, parameters, count = len(reference.light), len(basis) + 2, len(u)
    grid = Grid(
        uv=np.ascontiguousarray([u, v], np.float32),
        scale=(np.float32(reference.half_width_px), np.float32(flux)),
        monomials=_monomials(modes),
        basis=basis.astype(np.float32),
        light=np.empty((lenslets, count), np.float32),
        inverse=np.empty((lenslets, parameters, count), np.float32),
        descent=np.empty((lenslets, parameters, count), np.float32),
        weight=np.empty((lenslets, count), np.float32),
    )
    per_pixel, per_light = _unknown(lenslets, modes.count), _unknown(lenslets, modes.count)
    smooth = _smooth(reference)
    for first in range(0, lenslets, _AT_ONCE):
        some = slice(first, first + _AT_ONCE)
        light, gradient = reference.light[some][:, pixels], reference.gradient[some][:, pixels]
        warp = np.concatenate(
            [
                gradient[:, None, :, 0] * values + light[:, None] * slopes[..., 0],
                gradient[:, None, :, 1] * values + light[:, None] * slopes[..., 1],
            ],
            axis=1,
        )
        warp = warp if rotation else basis @ warp
        descent = np.concatenate([warp, light[:, None], np.ones((len(light), 1, count))], axis=1)
        expected = np.maximum(smooth[some][:, pixels], 0)
        weight = np.ones_like(light) if noise is None else _weight(expected, noise)
        weight *= reference.usable[some][:, pixels] & reference.lit[some, None]
        weight /= np.maximum(weight.mean(axis=1, keepdims=True), _NOTHING)
        weighted = descent * weight[:, None]
        norm = np.sqrt(np.einsum("lkn,lkn->lk", descent, weighted))[..., None]
        norm[norm == 0] = 1
        normal = weighted @ np.swapaxes(descent, 1, 2) / norm / np.swapaxes(norm, 1, 2)
        inverse = np.linalg.pinv(normal, rcond=1e-9, hermitian=True) @ (weighted / norm) / norm
        grid.light[some], grid.weight[some] = light, weight
        grid.inverse[some], grid.descent[some] = inverse, descent
        per_pixel.put(some, _propagated(np.ones_like(light), inverse, weight, descent, basis))
        per_light.put(some, _propagated(expected, inverse, weight, descent, basis))
    return Template(grid, reference.light[:, pixels].std(axis=1), per_pixel, per_light)


def _monomials(modes: PolynomialModes) -> Image:
    """Write the field modes as polynomials of u and v: (Q, monomial)."""
    u, v = (grid.ravel() for grid in np.meshgrid(np.linspace(-1, 1, 7), np.linspace(-1, 1, 7)))
    powers = np.stack([u**m * v**n for m, n in MONOMIALS])
    values = modes.values(u, v)
    monomials = values @ np.linalg.pinv(powers)
    require({"the field modes of a warp must be cubic at most": bool(np.allclose(monomials @ powers, values))})
    return monomials.astype(np.float32)


def _weight(expected: Floats, noise: CameraNoise) -> Floats:
    """How much each pixel counts: the inverse square of the residual to be expected where the light is so much, (L, N).

    That is the noise, and what the warp cannot explain.
    """
    peak = np.maximum(expected.max(axis=1, keepdims=True), np.finfo(np.float32).tiny)
    return np.asarray(1 / (noise.variance(expected) / peak**2 + _MODEL_ERROR**2))


def _propagated(variance: Floats, inverse: Floats, weight: Floats, descent: Floats, basis: Floats) -> Propagated:
    """Carry noise of independent pixels, (L, N), through the fit with A = `inverse` (L, P, N) and J = `descent`."""
    count, modes = len(basis), basis.shape[1] // 2
    warp = inverse[:, :count]
    covariance = (warp * variance[:, None]) @ np.swapaxes(warp, 1, 2)
    if count < 2 * modes:
        covariance = basis.T @ covariance @ basis
    covariance = covariance.reshape(-1, 2, modes, 2, modes)
    leverage = np.einsum("lkn,lkn->ln", inverse, descent)
    return Propagated(
        covariance=np.ascontiguousarray(covariance.transpose(0, 2, 1, 4, 3)),
        square=np.sum(weight * variance, axis=1),
        fitted=np.sum(weight * variance * leverage, axis=1),
    )


def _unknown(lenslets: int, modes: int) -> Propagated:
    """Room for what is to be filled in."""
    return Propagated(np.empty((lenslets, modes, 2, modes, 2)), np.empty(lenslets), np.empty(lenslets))


def _smooth(reference: ReferenceSubimages) -> Floats:
    """The light that is expected, (L, N): of a noisy reference the mean of neighbours.

    Weights from each pixel's own light would favour those that happen to be too dark.
    """
    light = reference.light.reshape(-1, reference.width, reference.width)
    return np.asarray(ndimage.uniform_filter(light, (0, 3, 3), mode="nearest").reshape(reference.light.shape))
