"""What a reference shows of a warp: the displacements that are fitted, and the pixels that are looked at.

Both are chosen by the Fisher information of the mean subimage. Inside a uniform source nothing moves visibly, so that
some displacements are hidden and many pixels tell nothing.
"""

import numpy as np

from reconstruction.arrays import Floats, Mask
from reconstruction.frame.noise import CameraNoise
from reconstruction.modes.field_modes import PolynomialModes, gradient_basis
from reconstruction.registration.gauss_newton.template import (
    pixel_weights,
    smooth_light,
    steepest_descent,
    without_brightness,
)
from reconstruction.registration.subimages import ReferenceSubimages

# Standard error over the least one, of a displacement that the reference hardly shows.
_BLIND = 6.0
_ROUGHER = 3.0  # weight of a degree over the one below it, in choosing the smoothest of displacements that look alike
# By which the standard errors may grow for fewer pixels: with 1.01, systematic errors grow by a third.
_SCATTER = 1.002


def visible_warp(
    reference: ReferenceSubimages, modes: PolynomialModes, pixels: Mask, *, conserve_flux: bool, rotation: bool
) -> tuple[Floats, Floats, Mask]:
    """Find what the mean subimage shows of a warp with some field modes on some pixels (width, width).

    Without `rotation` the displacement is the gradient of a potential over the field. Of displacements that look
    alike, the smoothest stand for the others.

    Returns
    -------
    basis : (K, 2Q)
        Orthonormal displacements (x modes, y modes) that are shown.
    alike : (K, 2Q)
        From any displacement to the parameters of the one that stands for it.
    pixels : (width, width)
        Those that tell most of them.
    """
    possible = np.eye(2 * modes.count) if rotation else gradient_basis(modes)
    descent, weight = _mean_descent(reference, modes, pixels, possible, reference.noise, conserve_flux=conserve_flux)
    normal = (descent * weight) @ descent.T
    # Without what gain and offset explain.
    shown = normal[:-2, :-2] - normal[:-2, -2:] @ np.linalg.solve(normal[-2:, -2:], normal[-2:, :-2])
    certainty, vectors = np.linalg.eigh(shown)
    kept = certainty > certainty[-1] / _BLIND**2
    combined = alike = np.eye(len(certainty))
    if not kept.all():
        roughness = (possible * np.tile(_ROUGHER ** (2 * modes.degree), 2)) @ possible.T
        combined = np.linalg.qr(np.linalg.solve(roughness, vectors[:, kept]))[0].T  # with what does not show
        alike = np.linalg.solve(vectors[:, kept].T @ combined.T, vectors[:, kept].T)
    chosen = pixels.copy()
    chosen[pixels] = _informative(np.concatenate([combined @ descent[:-2], descent[-2:]]), weight)
    return combined @ possible, alike @ possible, chosen


def _mean_descent(
    reference: ReferenceSubimages,
    modes: PolynomialModes,
    pixels: Mask,
    basis: Floats,
    noise: CameraNoise | None,
    *,
    conserve_flux: bool,
) -> tuple[Floats, Floats]:
    """Steepest-descent images of the mean subimage (P, N), gain and offset last, and weights of its pixels (N,)."""
    window = pixels.ravel()
    u, v = reference.offset_px[window].T / reference.half_width_px
    light, gradient, expected = (
        of_lenslets[reference.lit].mean(axis=0, keepdims=True)
        for of_lenslets in (
            reference.light[:, window],
            reference.gradient[:, window],
            smooth_light(reference)[:, window],
        )
    )
    slopes = modes.gradients(u, v) / reference.half_width_px * conserve_flux
    descent = steepest_descent(light, gradient, modes.values(u, v), slopes, basis)
    weight = np.ones((1, len(u))) if noise is None else pixel_weights(expected, noise)
    return (descent if conserve_flux else without_brightness(descent, weight, u, v))[0], weight[0]


def _informative(descent: Floats, weight: Floats) -> Mask:
    """Fewest pixels (N,), those with most leverage, that let the standard errors grow by `_SCATTER` at most."""
    scale = np.sqrt(np.sum(descent**2 * weight, axis=1, keepdims=True))
    scaled = descent / scale
    leverage = weight * np.einsum("pn,pq,qn->n", scaled, np.linalg.pinv((scaled * weight) @ scaled.T), scaled)
    order = np.argsort(-leverage)

    def scatter(count: int) -> float:
        some = order[:count]
        covariance = np.linalg.pinv((scaled[:, some] * weight[some]) @ scaled[:, some].T, hermitian=True)
        return float(np.sqrt(np.trace((covariance / scale / scale.T)[:-2, :-2])))

    whole, counts = scatter(len(order)), np.linspace(0.4, 1.0, 25) * len(order)
    enough = next(int(count) for count in counts if scatter(int(count)) <= _SCATTER * whole)
    chosen = np.zeros(len(order), np.bool_)
    chosen[order[:enough]] = True
    return chosen
