"""Steepest-descent images and pseudo-inverse of each reference lenslet, precomputed.

The steepest-descent images, d(residual)/dc_q = d(I0 T_q)/dx, are those of the reference, so that their pseudo-inverse
does not depend on the frame and a step is one product with the residual (after Baker and Matthews 2004, International
Journal of Computer Vision 56, 221). With known noise, pixels have inverse-variance weights: A = (J W J^T)^-1 J W.

Which displacements are fitted (`visible_warp`), and on which pixels, is chosen by the Fisher information of the mean
subimage. Inside a uniform source nothing moves visibly, so that some displacements are hidden and many pixels tell
nothing.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from reconstruction.arrays import Booleans, Floats, Image
from reconstruction.displacement import LINEAR_TERMS, TRANSMISSION_MODES
from reconstruction.frame.noise import CameraNoise
from reconstruction.frame.spline import interpolate, mean_interpolation, spline_coefficients
from reconstruction.geometry import require
from reconstruction.modes.field_modes import LegendreModes, PolynomialModes, gradient_basis
from reconstruction.registration.gauss_newton._alignment import Grid
from reconstruction.registration.gauss_newton._lenslet_fits import Propagated, WholePixelSearch
from reconstruction.registration.gauss_newton._warped_sampling import MONOMIALS, window_of
from reconstruction.registration.response import OwnWavefront
from reconstruction.registration.subimages import LensletModel, ReferenceSubimages
from reconstruction.runtime.threads import in_threads

# Model error over the brightest pixel of a subimage. Without it the dark surround of a bright subimage, which holds
# scattered light that no warp describes, would have most weight. With 0.003 the residual at 10,000 e- is 1.4 times
# as large, although the scatter is smaller.
_MODEL_ERROR = 0.02
_NOTHING = 1e-12  # share of a lenslet's information that is none; keeps a division from one by zero
_CUBIC = LegendreModes(10)  # brightness over the field
# RMS of a brightness in each cubic polynomial, for the choice: behind a sample with 8 % RMS of absorption over 0.5 mm.
_CUBIC_RMS = 0.011
_UNSEEN = 1e-6  # singular value over the largest, below which a reference does not show a parameter
_DECIMALS = 12  # of the terms of a polynomial, which are of the order of 1
_AT_ONCE = 32  # lenslets at a time, whose arrays fit into the processor's cache
# Standard error over the least one, of a displacement that the reference hardly shows.
_BLIND = 6.0
_ROUGHER = 3.0  # weight of a degree over the one below it, in choosing the smoothest of displacements that look alike
# By which the standard errors may grow for fewer pixels: with 1.01, systematic errors grow by a third.
_ERROR_GROWTH = 1.002


@dataclass(frozen=True, slots=True, eq=False)
class Template:
    """The reference prepared for one warp: L lenslets, N pixels, Q field modes, P parameters."""

    grid: Grid
    images: "SteepestDescent"  # of this warp
    per_pixel: Propagated  # of noise with variance 1 in every pixel
    per_light: Propagated  # of shot noise, whose variance is the light
    brightness: Image  # from the residual to that of the source, over the gain's, (L, 6, N); see `SteepestDescent`
    brightness_covariance: Floats  # of it, for noise of 1 in every pixel and for shot noise, (2, L, 6, 6)

    def without(self, lenslets: NDArray[np.intp], excluded: Booleans) -> tuple[Propagated, Propagated, Floats]:
        """`per_pixel` and `per_light` of some lenslets (K,) with pixels `excluded` (K, N).

        Also the share of the information about the parameters that remains, (K,).
        """
        grid, descent = self.grid, np.asarray(self.grid.descent[lenslets], np.float64)
        inverse = np.asarray(grid.inverse[lenslets], np.float64) * grid.unit[lenslets, :, None] * ~excluded[:, None]
        left = inverse @ np.swapaxes(descent, 1, 2)
        share = np.clip(np.trace(left, axis1=1, axis2=2) / left.shape[1], 0, 1)
        left[share < _NOTHING] = np.eye(left.shape[1])
        inverse = np.linalg.pinv(left) @ inverse
        weight = np.asarray(self.grid.weight[lenslets], np.float64)
        whole = weight.sum(axis=1, keepdims=True)
        weight *= ~excluded
        weight *= whole / np.maximum(weight.sum(axis=1, keepdims=True), _NOTHING)
        light = np.maximum(self.grid.light[lenslets], 0)
        return *(_propagated(v, inverse, weight, descent) for v in (np.ones_like(light), light)), share


class SteepestDescent:
    """Changes of subimages per unit of each parameter of a warp on some pixels, gain and offset last.

    For d along x they are d(I0 T_q)/dx = T_q dI0/dx + I0 dT_q/dx, the second term only if flux is conserved; those of
    gain and offset are I0 and 1.
    """

    def __init__(
        self,
        reference: ReferenceSubimages,
        modes: PolynomialModes,
        pixels: Booleans,
        basis: Floats,
        *,
        conserve_flux: bool,
        brightness: Floats | None = None,
        terms: int = LINEAR_TERMS,
    ) -> None:
        """Prepare displacements (x modes, y modes), the rows of `basis` (P - 2, 2Q), on pixels (width, width).

        The first `terms` of a brightness over the field are no displacement; `brightness`: see `source_brightness`.
        """
        self.reference, self.modes, self.pixels, self.basis = reference, modes, pixels, basis
        self.conserves_flux, self.source_brightness = conserve_flux, brightness
        u, v = reference.offset_px[pixels.ravel()].T / reference.half_width_px
        self._values = modes.values(u, v)
        self._over_field = LegendreModes(max(terms, TRANSMISSION_MODES.count)).values(u, v)
        self._nuisance = slice(1, terms)
        self._image, self._blurred = np.ones_like(u), np.zeros_like(self._over_field)
        if brightness is not None:
            self._image, self._blurred = brightness[0, pixels], brightness[: len(self._over_field), pixels]
            self._blurred -= self._over_field * self._image
        self._slopes = modes.gradients(u, v) / reference.half_width_px * conserve_flux

    def __call__(self, light: Floats, gradient: Floats) -> Floats:
        """Images (L, P, N) of subimages with that light (L, N), and its gradient (L, N, xy)."""
        light = light[:, None]
        along = [gradient[:, None, :, axis] * self._values + light * self._slopes[..., axis] for axis in (0, 1)]
        return np.concatenate([self.basis @ np.concatenate(along, axis=1), light, np.ones_like(light)], axis=1)

    def without_brightness(self, descent: Floats, weight: Floats) -> Floats:
        """Part of images (L, P, N) that no brightness of the source, a polynomial of u and v, explains.

        With weights (L, N) of the pixels; all of them where flux is conserved. A sample that absorbs, scintillation and
        uneven light change the brightness over the field. What looks like that would count as a displacement.
        """
        if self.conserves_flux:
            return descent
        varying = self.varying(descent[:, -2])[:, self._nuisance]
        weighted = varying * weight[:, None]
        squares = weighted @ np.swapaxes(varying, 1, 2)
        share = np.linalg.pinv(squares, rcond=1e-9, hermitian=True) @ (weighted @ np.swapaxes(descent, 1, 2))
        return np.asarray(descent - np.swapaxes(share, 1, 2) @ varying)

    def brightness(self, descent: Floats, weight: Floats) -> Floats:
        """From residuals to a brightness in `TRANSMISSION_MODES`, fitted with all else, (L, 6, N)."""
        varying, others = self.varying(descent[:, -2]), np.delete(descent, -2, axis=1)
        return _least_squares(np.concatenate([varying, others], axis=1), weight)[:, : TRANSMISSION_MODES.count]

    def varying(self, light: Floats) -> Floats:
        """Subimages (L, N) with a brightness in each Legendre polynomial over the field, (L, mode, N)."""
        share = light @ self._image / (self._image @ self._image)
        return np.asarray(light[:, None] * self._over_field + share[:, None, None] * self._blurred)


def source_brightness(model: LensletModel) -> Floats:
    """Images of the source times cubic Legendre polynomials over the field, (mode, row, column).

    They are blurred after they are multiplied: a subimage times a brightness that grows by the share b per px would be
    one that is displaced by b times the square of the blur's width.
    """
    images = np.stack([model.image(values) for values in _CUBIC.values(*model.position.T)])
    blur, _ = mean_interpolation(images.shape[-1])
    return np.asarray(blur @ images @ blur.T)  # interpolated like the subimages


def absorption_terms(
    brightness: Floats, reference: ReferenceSubimages, modes: PolynomialModes, pixels: Booleans, basis: Floats
) -> int:
    """Number of terms of a `source_brightness` to take out behind samples that absorb.

    Of quadratic and cubic ones, those with the less expected error of the displacements in the rows of `basis`, on
    `pixels` (width, width), by the noise, which must be known.
    """
    noise = reference.noise
    if noise is None:
        return LINEAR_TERMS
    light, gradient, expected = _mean_lenslet(reference, pixels)
    weight = _pixel_weights(expected, noise)

    def descent(terms: int) -> SteepestDescent:
        return SteepestDescent(reference, modes, pixels, basis, conserve_flux=False, brightness=brightness, terms=terms)

    only_cubic = descent(_CUBIC.count).varying(light)[0, TRANSMISSION_MODES.count :]

    def expected_error(terms: int) -> float:
        """Sum of the displacements' variances, px^2, by noise and the cubic brightness left in."""
        images = descent(terms)
        fit = _least_squares(images.without_brightness(images(light, gradient), weight), weight)[0, :-2]
        return float(np.sum(fit**2 * noise.variance(expected)) + np.sum((_CUBIC_RMS * fit @ only_cubic.T) ** 2))

    return min(_CUBIC.count, TRANSMISSION_MODES.count, key=expected_error)


def respond(template: Template, image: Floats, changes: Floats, own: Sequence[OwnWavefront]) -> Floats:
    """Parameters found for changes (..., row, column) of a noise-free subimage; see `GaussNewton`.

    The displaced subimage is interpolated. The steps of the template are scaled by those for a warp of that subimage.
    """
    images, lenslets = template.images, len(template.grid.weight)
    row, column = np.nonzero(images.pixels)
    parts, unit = np.stack([image, *(wavefront.image for wavefront in own)]), np.max(image)
    at_pixels = np.stack([column, row], -1).astype(float)
    slopes = [interpolate(spline_coefficients(np.asarray(part / unit, np.float32)), at_pixels)[1] for part in parts]
    still_light, still_gradient = parts[:, row, column], unit * np.stack(slopes)
    blur, slope = mean_interpolation(images.reference.width)
    moved_light = (blur @ parts @ blur.T)[:, row, column]
    moved_gradient = np.stack([blur @ parts @ slope.T, slope @ parts @ blur.T], axis=-1)[:, row, column]
    of_parts = np.stack([changes, *(wavefront.changes for wavefront in own)]).reshape(len(parts), -1, *image.shape)
    pixel_changes = np.swapaxes((blur @ of_parts @ blur.T)[..., row, column], 1, 2)  # (part, pixel, change)
    amplitudes = np.stack([np.ones(lenslets), *(wavefront.rad for wavefront in own)], axis=1)  # (lenslet, part)

    def descent(light: Floats, gradient: Floats, amplitude: Floats) -> Floats:
        of_lenslets = images(np.tensordot(amplitude, light, 1), np.tensordot(amplitude, gradient, 1))
        of_lenslets[:, -1] *= np.mean(image)  # of the size of the others
        return of_lenslets

    def found(some: slice) -> Floats:
        # Not the lenslet's own light: it may lie beside the middle of its window, where the image is.
        weight = np.asarray(template.grid.weight[some], np.float64)
        amplitude = amplitudes[some] if own else amplitudes[:1]  # without, all are alike
        still = descent(still_light, still_gradient, amplitude)
        projected = images.without_brightness(still, weight) * weight[:, None]  # (lenslet, P, pixel)
        squares = projected @ np.swapaxes(descent(moved_light, moved_gradient, amplitude), 1, 2)
        of_changes = projected @ np.tensordot(amplitude, pixel_changes, 1)  # (lenslet, P, change)
        parameters = -np.linalg.pinv(squares, rcond=_UNSEEN**2) @ of_changes
        return np.swapaxes(parameters[:, : len(images.basis)], 1, 2)

    chunks = [slice(first, first + _AT_ONCE) for first in range(0, lenslets, _AT_ONCE)]
    each = np.concatenate(in_threads(found, chunks))
    return each.reshape(lenslets, *changes.shape[:-2], -1)


def prepare_template(images: SteepestDescent, noise: CameraNoise | None = None) -> Template:
    """Prepare a warp, given by its steepest-descent images.

    What a brightness explains is left out. Without `noise` all pixels have equal weight.
    """
    reference, modes, basis, of_window = images.reference, images.modes, images.basis, images.pixels.ravel()
    flux = 1 / reference.half_width_px if images.conserves_flux else 0.0
    gradients = gradient_basis(modes)
    lenslets, parameters, count = len(reference.light), len(basis) + 2, np.count_nonzero(of_window)
    grid = Grid(
        window=window_of(images.pixels, reference.steps_px / reference.half_width_px),
        scale=(np.float32(reference.half_width_px), np.float32(flux)),
        monomials=_monomials(modes, basis),
        basis=basis.astype(np.float32),
        light=np.empty((lenslets, count), np.float32),
        level=np.empty((lenslets, 2), np.float32),
        inverse=np.empty((lenslets, parameters, count), np.int16),
        unit=np.empty((lenslets, parameters), np.float32),
        descent=np.empty((lenslets, parameters, count), np.float32),
        weight=np.empty((lenslets, count), np.float32),
        normal=np.empty((lenslets, parameters, parameters), np.float32),
        bend=_mean_square_gradient(modes, basis, reference.half_width_px).astype(np.float32),
        is_gradient=bool(np.allclose(basis @ gradients.T @ gradients, basis)),
    )
    terms = TRANSMISSION_MODES.count
    to_brightness = np.empty((lenslets, terms, count), np.float32)
    covariance = np.empty((2, lenslets, terms, terms))

    def prepare(first: int) -> tuple[Propagated, Propagated]:
        some = slice(first, first + _AT_ONCE)
        light, gradient = reference.light[some][:, of_window], reference.gradient[some][:, of_window]
        descent = images(light, gradient)
        weight = np.ones_like(light)
        if noise is not None:
            weight = _pixel_weights(_smooth_light(reference, some)[:, of_window], noise)
        weight *= reference.usable[some][:, of_window] & reference.lit[some, None]
        weight /= np.maximum(weight.mean(axis=1, keepdims=True), _NOTHING)
        weighted = descent * weight[:, None]
        grid.descent[some], grid.normal[some] = descent, weighted @ np.swapaxes(descent, 1, 2)
        of_brightness = images.brightness(descent, weight)
        for kind, variance in enumerate((np.ones_like(light), np.maximum(light, 0))):
            covariance[kind, some] = (of_brightness * variance[:, None]) @ np.swapaxes(of_brightness, 1, 2)
        descent = images.without_brightness(descent, weight)
        inverse = _least_squares(descent, weight)
        grid.light[some], grid.weight[some] = light, weight
        unit = np.maximum(np.abs(inverse).max(axis=-1), np.finfo(np.float32).tiny) / np.iinfo(np.int16).max
        grid.unit[some], grid.inverse[some] = unit, np.rint(inverse / unit[..., None])
        grid.level[some] = np.stack([light.mean(axis=1), light.std(axis=1)], axis=1)
        of_brightness[:, 0] -= inverse[:, -2]  # which is in the gain already
        to_brightness[some] = of_brightness
        of_pixels = _propagated(np.ones_like(light), inverse, weight, descent)
        return of_pixels, _propagated(np.maximum(light, 0), inverse, weight, descent)

    prepared = in_threads(prepare, range(0, lenslets, _AT_ONCE))
    parts = zip(*prepared, strict=True)
    of_pixels, of_light = (Propagated(*map(np.concatenate, zip(*each, strict=True))) for each in parts)
    return Template(grid, images, of_pixels, of_light, to_brightness, covariance)


def _least_squares(images: Floats, weight: Floats) -> Floats:
    """From residuals to the parameters with images (L, P, N), for weights (L, N) of the pixels: (L, P, N)."""
    weighted = images * weight[:, None]
    norm = np.sqrt(np.einsum("lkn,lkn->lk", images, weighted))[..., None]
    norm[norm == 0] = 1
    normal = weighted @ np.swapaxes(images, 1, 2) / norm / np.swapaxes(norm, 1, 2)
    return np.asarray(np.linalg.pinv(normal, rcond=1e-9, hermitian=True) @ (weighted / norm) / norm)


def _mean_square_gradient(modes: PolynomialModes, basis: Floats, half_width_px: float) -> Floats:
    """Mean squared gradient of each parameter's displacement over the field, per px^2: (P - 2,)."""
    nodes, weights = np.polynomial.legendre.leggauss(6)
    slopes = modes.gradients(nodes, nodes[:, None]) / half_width_px  # (Q, node, node, xy)
    slopes = np.einsum("paq,qyxb->pyxab", basis.reshape(-1, 2, modes.count), slopes)
    return np.asarray(np.einsum("pyxab,y,x->p", slopes**2, weights, weights) / 4)


def _monomials(modes: PolynomialModes, basis: Floats) -> Image:
    """Displacement of each parameter as polynomials of u and v: (P - 2, xy, monomial)."""
    u, v = (grid.ravel() for grid in np.meshgrid(np.linspace(-1, 1, 7), np.linspace(-1, 1, 7)))
    powers = np.stack([u**m * v**n for m, n in MONOMIALS])
    values = modes.values(u, v)
    monomials = np.round(values @ np.linalg.pinv(powers), _DECIMALS)  # what is no term is 0
    require({"the field modes of a warp must be quartic at most": bool(np.allclose(monomials @ powers, values))})
    return (basis.reshape(-1, 2, modes.count) @ monomials).astype(np.float32)


def _pixel_weights(expected: Floats, noise: CameraNoise) -> Floats:
    """Inverse square of the residual expected for that light, (L, N): noise, and model error."""
    peak = np.maximum(expected.max(axis=1, keepdims=True), np.finfo(np.float32).tiny)
    return np.asarray(1 / (noise.variance(expected) / peak**2 + _MODEL_ERROR**2))


def coefficient_covariance(covariance: Floats, basis: Floats) -> Floats:
    """Covariance (L, Q, xy, Q, xy) of coefficients, from that of parameters (L, P, P) of a basis (P, 2Q)."""
    parameters, modes = len(basis), basis.shape[1] // 2
    basis = np.swapaxes(basis.reshape(parameters, 2, modes), 1, 2).reshape(parameters, -1)
    half = (covariance.reshape(-1, parameters) @ basis).reshape(-1, parameters, 2 * modes)  # one product: faster than L
    whole = np.swapaxes(half, 1, 2).reshape(-1, parameters) @ basis
    return whole.reshape(-1, modes, 2, modes, 2)


def _propagated(variance: Floats, inverse: Floats, weight: Floats, descent: Floats) -> Propagated:
    """Propagate noise of independent pixels, (L, N), through A = `inverse` (L, P, N), J = `descent`."""
    warp = inverse[:, :-2]
    leverage = np.einsum("lkn,lkn->ln", inverse, descent)
    covariance = (warp * variance[:, None]) @ np.swapaxes(warp, 1, 2)
    return Propagated(
        covariance,
        square=np.sum(weight * variance, axis=1),
        fitted=np.sum(weight * variance * leverage, axis=1),
        trace=np.einsum("lpp->l", covariance),
    )


def _smooth_light(reference: ReferenceSubimages, some: slice = slice(None)) -> Floats:
    """Mean light over neighbours, (L, N): weights from single noisy pixels would favour dark ones."""
    light = reference.light[some].reshape(-1, reference.width, reference.width)
    smooth = ndimage.uniform_filter(light, (0, 3, 3), mode="nearest").reshape(len(light), -1)
    return np.maximum(smooth, 0.0)


def _mean_lenslet(reference: ReferenceSubimages, pixels: Booleans) -> tuple[Floats, Floats, Floats]:
    """Mean light of lit lenslets, its gradient and expected light on pixels (width, width): (1, N, ...)."""
    share = reference.lit / np.count_nonzero(reference.lit)
    chunks = [slice(first, first + _AT_ONCE) for first in range(0, len(share), _AT_ONCE)]
    smooth = in_threads(lambda some: share[some] @ _smooth_light(reference, some), chunks)
    light, gradient = share @ reference.light, np.tensordot(share, reference.gradient, axes=1)
    return light[None, pixels.ravel()], gradient[None, pixels.ravel()], np.sum(smooth, axis=0)[None, pixels.ravel()]


def visible_warp(
    reference: ReferenceSubimages, modes: PolynomialModes, pixels: Booleans, *, conserve_flux: bool, may_rotate: bool
) -> tuple[Floats, Floats, Booleans]:
    """Find what the mean subimage shows of a warp with some field modes on some pixels (width, width).

    Unless it `may_rotate`, the displacement is the gradient of a potential over the field. Of displacements that look
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
    possible = np.eye(2 * modes.count) if may_rotate else gradient_basis(modes)
    images = SteepestDescent(reference, modes, pixels, possible, conserve_flux=conserve_flux)
    light, gradient, expected = _mean_lenslet(reference, pixels)
    weight = np.ones(light.shape) if reference.noise is None else _pixel_weights(expected, reference.noise)
    descent, weight = images.without_brightness(images(light, gradient), weight)[0], weight[0]
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


def _informative(descent: Floats, weight: Floats) -> Booleans:
    """Fewest pixels (N,), by leverage, that let the standard errors grow by `_ERROR_GROWTH` at most."""
    scale = np.sqrt(np.sum(descent**2 * weight, axis=1, keepdims=True))
    scaled = descent / scale
    leverage = weight * np.einsum("pn,pq,qn->n", scaled, np.linalg.pinv((scaled * weight) @ scaled.T), scaled)
    order = np.argsort(-leverage)

    def scatter(count: int) -> float:
        some = order[:count]
        covariance = np.linalg.pinv((scaled[:, some] * weight[some]) @ scaled[:, some].T, hermitian=True)
        return float(np.sqrt(np.trace((covariance / scale / scale.T)[:-2, :-2])))

    whole, counts = scatter(len(order)), np.linspace(0.4, 1.0, 25) * len(order)
    enough = next(int(count) for count in counts if scatter(int(count)) <= _ERROR_GROWTH * whole)
    chosen = np.zeros(len(order), np.bool_)
    chosen[order[:enough]] = True
    return chosen


def prepare_search(reference: ReferenceSubimages) -> WholePixelSearch:
    """Prepare the search for shifts that keep the field, with half its blur, inside the lenslet's cell."""
    reach = max(int(reference.reach_px - reference.half_width_px), 0)
    width = 2 * int(reference.half_width_px + reference.blur_px / 2) + reference.width % 2
    width = min(width, reference.width - 2 * reach)  # the patch must not exceed the window
    inner = slice((reference.width - width) // 2, (reference.width + width) // 2)
    light = reference.light.reshape(-1, reference.width, reference.width)[:, inner, inner]
    light = light - light.mean(axis=(1, 2), keepdims=True)
    light /= np.maximum(light.std(axis=(1, 2), keepdims=True), 1e-30)  # over its contrast
    steps_px = reference.steps_px
    steps_px = steps_px[np.abs(steps_px) <= (width - 1) / 2 + reach]
    return WholePixelSearch(
        light=light.astype(np.float32),
        window=window_of(np.ones((steps_px.size, steps_px.size), np.bool_), steps_px / reference.half_width_px),
        scale=(np.float32(reference.half_width_px), np.float32(0.0)),
        reach=reach,
    )
