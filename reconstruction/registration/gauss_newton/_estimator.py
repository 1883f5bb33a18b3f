"""Registration by Gauss-Newton: the method of this instrument.

Light imaged at x in the reference arrives at x + d(x), and keeps its brightness but for a gain:

    I0(x) = gain I1(x + d(x)) + offset,    d(x) = sum_q c_q T_q(x / h)

with T_q the field modes and h the half width of the field on the subimage. What looks like a brightness of the source
that changes slowly over the field counts as no displacement. The paper's world, without propagation,
conserves flux instead, and the right side has the factor det(1 + dd/dx) (docs/methods.md). The fit starts from the
previous frame, or from a translation found on every other pixel, or, if that does not match, from the whole-pixel shift
with the best correlation.

Error bars follow from the camera's noise. Steepest-descent images see the slow part of it, which interpolation
preserves: the covariance is that of pixels without interpolation. The residual holds all of the noise, reduced by
interpolation.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from reconstruction.arrays import Booleans, Floats, Image, median
from reconstruction.displacement import LINEAR_TERMS, TRANSMISSION_MODES, Displacement, LensletStatus, Transmission
from reconstruction.frame.bad_pixels import repaired
from reconstruction.frame.spline import noise_power, noise_power_polynomial, shared_coefficients
from reconstruction.geometry import Field
from reconstruction.modes.field_modes import LegendreModes, PolynomialModes, gradient_basis, orthogonal_modes
from reconstruction.registration.gauss_newton._alignment import FrameData
from reconstruction.registration.gauss_newton._lenslet_fits import (
    CONVERGED_PX,
    FitLimits,
    Fits,
    Propagated,
    WorkArrays,
    fit_lenslets,
    new_work_arrays,
)
from reconstruction.registration.gauss_newton._template import (
    SteepestDescent,
    Template,
    absorption_terms,
    coefficient_covariance,
    prepare_search,
    prepare_template,
    respond,
    source_brightness,
    visible_warp,
)
from reconstruction.registration.response import OwnWavefront, WarpRegistration
from reconstruction.registration.subimages import MISFIT, LensletModel, ReferenceSubimages, classify_lenslets
from reconstruction.runtime.counters import new_counters
from reconstruction.runtime.deferred import Deferred
from reconstruction.runtime.threads import THREADS, worker_pool
from reconstruction.settings import FIELD_MODES, RegistrationSettings


@dataclass(frozen=True, slots=True, eq=False)
class FitCovariance:
    """Covariance of the coefficients of fits: noise variances times what the fits make of them."""

    variance: Floats  # of every pixel, counts^2, and per count of light, counts; (lenslet_row, lenslet_column, 2)
    per_pixel: Propagated  # for a variance of 1 in every pixel
    per_light: Propagated  # for one that is the light
    basis: Floats  # coefficients (x modes, y modes) of the parameters, (P, 2Q)

    def kept(self, lenslets: Booleans) -> Self:
        """The same, lost for all but some lenslets (L,)."""
        if lenslets.all():
            return self
        return replace(self, variance=np.where(lenslets.reshape(*self.variance.shape[:2], 1), self.variance, np.nan))

    def __call__(self) -> Floats:
        """The covariance, px^2, (lenslet_row, lenslet_column, field_mode, xy, field_mode, xy)."""
        of_pixels, of_light = self.variance.reshape(-1, 2, 1, 1).swapaxes(0, 1)
        of_parameters = of_pixels * self.per_pixel.covariance + of_light * self.per_light.covariance
        covariance = coefficient_covariance(of_parameters, self.basis)
        return covariance.reshape(*self.variance.shape[:2], *covariance.shape[1:])

    def trace(self) -> Floats:
        """Sum of the variances, px^2, (lenslet_row, lenslet_column); the basis is orthonormal."""
        shape = self.variance.shape[:2]
        of_pixels, of_light = self.per_pixel.trace.reshape(shape), self.per_light.trace.reshape(shape)
        return np.asarray(self.variance[..., 0] * of_pixels + self.variance[..., 1] * of_light)


class ErrorPropagation:
    """Propagates noise through the fits against one reference."""

    def __init__(self, template: Template) -> None:
        reference = template.images.reference
        noise, self._template, self._lattice = reference.noise, template, reference.lenslets
        # Variance per count of light, counts, and of every pixel, counts^2.
        self._knows_noise = noise is not None
        self._shot, self._read = (0.0, 0.0) if noise is None else (noise.counts_per_light, noise.read_noise_counts**2)
        self._basis = template.grid.basis.astype(np.float64)
        self._of_reference = 1 / reference.reference_frames
        # Share of the noise of the reference that interpolation leaves: uniform, shot, (L, 2).
        power = noise_power(reference.position_px[:, template.images.pixels.ravel()])
        weight = np.stack([template.grid.weight, template.grid.weight * np.maximum(template.grid.light, 0)], axis=-1)
        total = np.maximum(weight.sum(axis=1), np.finfo(np.float32).tiny)
        self._reference_power = np.einsum("ln,lnk->lk", power, weight) / total

    @property
    def expected_square(self) -> Floats:
        """Expected weighted sum of squared noise, as a polynomial of the gain: (L, 3); zero if unknown."""
        shot, read = self._shot * self._template.per_light.square, self._read * self._template.per_pixel.square
        return np.stack([(shot + read) * self._of_reference, shot, read], axis=-1)

    @property
    def expected_sigma_px(self) -> Floats:
        """RMS standard error of the parameters in a frame as bright as the reference, (L,); 0 if unknown."""
        shot, read = self._shot * self._template.per_light.trace, self._read * self._template.per_pixel.trace
        return np.asarray(np.sqrt((shot + read) / self._template.grid.basis.shape[0]))

    def __call__(self, fits: Fits) -> tuple[FitCovariance, Floats, Floats, Floats]:
        """Errors of the fits of L lenslets; arbitrary for lost ones.

        The covariance, from the residual if the noise is unknown; the reduced chi-square, (L,), NaN if it is; the
        weighted sum of squares of the residual minus its noise, counts^2, (L,); and the share of the information of a
        lenslet's pixels that the usable ones have, (L,).
        """
        per_pixel, per_light = self._template.per_pixel, self._template.per_light
        information_left = np.ones(len(fits.gain))
        partial = np.flatnonzero(fits.is_partial)
        if partial.size:
            *of_partial, information_left[partial] = self._template.without(partial, fits.excluded[partial])
            per_pixel, per_light = (
                whole.replaced(partial, part) for whole, part in zip((per_pixel, per_light), of_partial, strict=True)
            )
        gain, power, still = fits.gain, fits.noise_power, self._reference_power
        of_light, expected, chi_square = np.zeros((3, len(gain)))
        with np.errstate(all="ignore"):  # of lost lenslets
            if self._knows_noise:
                # Noise of the frame, scaled to the brightness of the reference, and of the reference.
                shot, read = self._shot * gain, self._read * gain**2
                shot_still, read_still = self._shot * self._of_reference, self._read * self._of_reference
                of_pixels, of_light = read + read_still, shot + shot_still
                left_pixels = read * power[:, 0] + read_still * still[:, 0]
                left_light = shot * power[:, 1] + shot_still * still[:, 1]
                expected = left_pixels * per_pixel.square - of_pixels * per_pixel.fitted
                expected += left_light * per_light.square - of_light * per_light.fitted
                chi_square = fits.square / expected
            else:
                of_pixels = fits.square / (power[:, 0] * per_pixel.square - per_pixel.fitted)
                chi_square[:] = np.nan
        variance = np.stack([of_pixels, of_light], axis=-1).reshape(*self._lattice, 2)
        covariance = FitCovariance(variance, per_pixel, per_light, self._basis)
        return covariance, chi_square, fits.square - expected, information_left


# Margin of the pixels used beyond the field's edge, in blurs. Further out there is only scattered light, which no warp
# describes. With 0.8 the wavefront error at the shortest correlation length of evidence/accuracy.md is 0.157 rad, with
# 1.3 0.098, as with all pixels of the cell.
_MARGIN_BLURS = 1.3
# Largest remaining error of a fit's parameters: a share of its standard error, within limits. Most errors are far
# smaller: on warm frames with 2000 electrons their RMS is 0.05 standard errors, which adds a thousandth to the noise.
_TOLERANCE, _TOLERANCE_PX = 0.4, (3e-4, 3e-3)
# Residual over contrast, and over that of most lenslets: above both, a lenslet is an outlier. Screens stay below 0.041
# and 2.6; a half-covered lenslet has 0.15.
_ODD, _OUTLYING = 0.08, 2.5
_NOISE_SHARE = 0.3  # of the noise's square, tolerated as chance
_POOR = _ODD  # residual over contrast above which another start is tried
_NOISE_AT_MOST = 1.5  # square of a residual's noise over its mean
_LEAST_INFORMATION = 0.75  # of a lenslet's pixels; with less it is lost


def prepare(
    reference: ReferenceSubimages,
    settings: RegistrationSettings,
    field: Field,
    model: LensletModel | None,
    *,
    absorbs: bool = False,
) -> WarpRegistration:
    """Prepare the method `gauss_newton` with the warp of the settings."""
    modes = orthogonal_modes(field, FIELD_MODES[settings.warp or "quadratic"])
    return GaussNewton(
        reference,
        modes,
        conserve_flux=field.neglect_propagation,
        may_rotate=settings.rotation,
        model=model,
        absorbs=absorbs,
        threads=settings.threads,
    )


class GaussNewton:
    """Gauss-Newton registration against one reference."""

    def __init__(
        self,
        reference: ReferenceSubimages,
        modes: PolynomialModes,
        *,
        conserve_flux: bool,
        may_rotate: bool,
        model: LensletModel | None = None,
        absorbs: bool = False,
        threads: int = THREADS,
    ) -> None:
        """Prepare for warps of the given field modes, and for that many threads.

        A `model` of the lenslets tells how a brightness over the field looks. More of it is no displacement behind a
        sample that `absorbs`; of other samples with depth, that would take a part of the displacements.
        """
        self.reference, self.modes, self._threads = reference, modes, threads
        near = np.abs(reference.steps_px) <= reference.half_width_px + _MARGIN_BLURS * reference.blur_px
        coarse = near & (np.arange(reference.width) % 2 == 0)
        translation = SteepestDescent(
            reference, LegendreModes(1), np.outer(coarse, coarse), np.eye(2), conserve_flux=conserve_flux
        )
        self._start = prepare_template(translation)
        basis, self.alike, pixels = visible_warp(
            reference, modes, np.outer(near, near), conserve_flux=conserve_flux, may_rotate=may_rotate
        )
        brightness, terms = None, LINEAR_TERMS
        if model is not None and not conserve_flux:
            brightness = source_brightness(model)
            terms = absorption_terms(brightness, reference, modes, pixels, basis) if absorbs else terms
        images = SteepestDescent(
            reference, modes, pixels, basis, conserve_flux=conserve_flux, brightness=brightness, terms=terms
        )
        self.absorbs = absorbs and brightness is not None
        self._warp = prepare_template(images, reference.noise)
        self.parameters = self._warp.grid.basis.astype(np.float64)  # orthonormal rows, as the compiled fit has them
        self.hidden = (2 * modes.count if may_rotate else len(gradient_basis(modes))) - len(self.parameters)
        self.brightness_terms = terms
        self._search = prepare_search(reference)
        self._errors = ErrorPropagation(self._warp)
        contrast = self._warp.grid.level[:, 1]
        self._unexplained = np.count_nonzero(self._warp.grid.weight, axis=1) * (MISFIT * contrast) ** 2
        self._power = noise_power_polynomial().astype(np.float32)
        self._idle_arrays: list[WorkArrays] = []  # that no thread uses now
        poor_square = _NOISE_AT_MOST * self._errors.expected_square
        poor_square[:, 0] += (_POOR * contrast) ** 2 * np.count_nonzero(pixels)
        tolerance_px = np.clip(_TOLERANCE * self._errors.expected_sigma_px, *_TOLERANCE_PX)
        self._limits = FitLimits(tolerance_px.astype(np.float32), poor_square.astype(np.float32))
        self._near_bad, self._touched_by_bad = self._near(reference.bad), reference.touched(reference.bad)
        # Compile now instead of at the first frame.
        dark = np.zeros((8, 8), np.float32)
        self._fit(dark, dark > 0, np.zeros(len(reference.lit), np.bool_), None, lambda: None)

    def __call__(self, light: Image, *, saturated: Booleans, start: Displacement | None = None) -> Displacement:
        """Register a frame; see `displacement.RegistrationMethod`."""
        reference, warp = self.reference, self._warp
        is_saturated = bool(saturated.any())
        bad = reference.bad | saturated if is_saturated else reference.bad
        unusable = reference.unusable | saturated if is_saturated else reference.unusable
        sees_bad = self._near(bad) if is_saturated else self._near_bad
        coefficients, filter_share = shared_coefficients(repaired(light, bad) if bad.any() else light)
        fits = self._fit(coefficients, unusable, sees_bad, start, filter_share)

        covariance, chi_square, unexplained, information_left = self._errors(fits)
        found = (fits.step_px < CONVERGED_PX) & (unexplained < self._unexplained)
        found &= ~_stands_out(unexplained, fits.square, self._unexplained, found)
        spoilt = information_left < _LEAST_INFORMATION
        fitted = (fits.displacement @ self.parameters).astype(np.float32).astype(np.float64)
        displacement = classify_lenslets(
            reference,
            self.modes,
            fitted.reshape(len(fits.gain), 2, self.modes.count),
            covariance=covariance,
            residual_rms=np.sqrt(fits.square / warp.grid.light.shape[1]) / warp.grid.level[:, 1].max(),
            contrast=fits.contrast,
            faults={
                LensletStatus.DIVERGED: ~found,
                LensletStatus.LEFT_CELL: spoilt,
                LensletStatus.DARK: spoilt & self._touched_by_bad,
                LensletStatus.SATURATED: spoilt & reference.touched(saturated),
            },
        )
        valid = displacement.valid
        return replace(
            displacement,
            chi_square=np.where(valid, chi_square.reshape(valid.shape), np.nan),
            transmission_source=Deferred(lambda: self._transmission(fits, covariance.variance, valid)),
            absorbs=self.absorbs,
        )

    def _transmission(self, fits: Fits, variance: Floats, valid: Booleans) -> Transmission:
        """Brightness of the subimages over the reference's; NaN for partly covered ones, too.

        At the end of the fit the residual is what the brightness explains beyond the gain, and noise. Its quadratic
        terms are fitted only here, together with what they would change of the displacement.
        """
        shape, warp = valid.shape, self._warp
        known = valid & ~fits.is_partial.reshape(shape)
        with np.errstate(divide="ignore", invalid="ignore"):
            per_gain = np.where(known, 1 / fits.gain.reshape(shape), np.nan)[..., None]
        beyond = np.einsum("lkn,ln->lk", warp.brightness, fits.residual).reshape(*shape, -1)
        beyond[..., 0] += 1
        terms = TRANSMISSION_MODES.count
        of_noise = np.einsum("rck,krcij->rcij", variance, warp.brightness_covariance.reshape(2, *shape, terms, terms))
        return Transmission(beyond * per_gain, of_noise * per_gain[..., None] ** 2)

    def _near(self, bad: Booleans) -> Booleans:
        """True for lenslets (L,) near `bad` pixels (row, column), or cut by the frame's edge."""
        near = self.reference.near(bad)
        near[self.reference.at_edge] = True
        return near

    def response(self, image: Floats, changes: Floats, own: Sequence[OwnWavefront] = ()) -> Floats:
        """See `response.WarpRegistration`. A warp of that subimage is found as it is."""
        return respond(self._warp, image, changes, own)

    def _fit(
        self,
        coefficients: Image,
        bad: Booleans,
        sees_bad: Booleans,
        start: Displacement | None,
        filter_share: Callable[[], None],
    ) -> Fits:
        """Fit all lenslets, shared among threads, to a frame given by its spline coefficients.

        `filter_share` computes these, in the same threads: handing over twice would take longer than it saves.
        """
        reference, grid = self.reference, self._warp.grid
        lenslets, pixels = grid.light.shape
        fits = Fits(
            displacement=self._begin(start),
            contrast=np.zeros(lenslets),
            gain=np.ones(lenslets),
            square=np.full(lenslets, np.inf),
            step_px=np.full(lenslets, np.inf),
            noise_power=np.ones((lenslets, 2)),
            is_partial=np.zeros(lenslets, np.bool_),
            excluded=np.zeros((lenslets, pixels), np.bool_),
            residual=np.zeros((lenslets, pixels), np.float32),
        )
        frame = FrameData(
            coefficients=coefficients,
            bad=bad,
            sees_bad=sees_bad,
            center_px=reference.center_px,
            turn=reference.turn[0].astype(np.float32),
            half_cell_px=np.float32(reference.side_px / 2),
        )

        counters, grids = new_counters(), (self._start.grid, grid)

        def share() -> bool:
            filter_share()
            try:
                arrays = self._idle_arrays.pop()
            except IndexError:
                arrays = new_work_arrays(grids, self._search)
            ended = fit_lenslets(frame, grids, self._search, self._limits, self._power, fits, arrays, counters)
            self._idle_arrays.append(arrays)
            return ended

        others = [worker_pool(self._threads - 1).submit(share) for _ in range(1, self._threads)]
        is_finished = share()
        for other in others:
            if not other.cancel() and not is_finished:
                other.result()
        return fits

    def _begin(self, start: Displacement | None) -> Image:
        """Start of the fits, parameters (L, P - 2), px; NaN for lenslets without a start."""
        lenslets, modes = len(self.reference.light), self.modes.count
        if start is None or start.coefficients.size != lenslets * modes * 2:
            return np.full((lenslets, len(self.parameters)), np.nan, np.float32)
        coefficients = np.swapaxes(start.coefficients.reshape(lenslets, modes, 2), 1, 2).reshape(lenslets, -1)
        return np.asarray(coefficients @ self.parameters.T, np.float32)


def _stands_out(unexplained: Floats, square: Floats, at_most: Floats, found: Booleans) -> Booleans:
    """Flag lenslets (L,) with outlying residuals, e.g. partly covered ones.

    `unexplained` (L,) is the residual's `square` (L,) minus its noise, counts^2, `at_most` (L,) its limit; `found` (L,)
    marks the lenslets with a match.
    """
    if not found.any():
        return np.zeros_like(found)
    with np.errstate(divide="ignore", invalid="ignore"):  # of lost lenslets
        share, noise = unexplained * (MISFIT**2 / at_most), (square - unexplained) * (MISFIT**2 / at_most)
        usual = max(median(share[found]), 0.0)
        return np.asarray(share > max(_ODD**2, _OUTLYING**2 * usual) + _NOISE_SHARE * noise)
