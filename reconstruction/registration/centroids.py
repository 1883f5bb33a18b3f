"""Registration by centroids of spots: one spot in each lenslet, or a grid of stars behind a pinhole mask.

A spot lies where the image, smoothed by a Gaussian, is brightest: there the centroid vanishes that is weighted by a
Gaussian about it (windowed centroid: Bertin and Arnouts 1996, Astron. Astrophys. Suppl. 117, 393). The weight's
variance is twice the spot's, so that the scatter is 1.13 times the Cramer-Rao bound, in photon noise as in read noise.
Among stars it is that of the spot: the light of neighbours would pull.
Pixels are weighted, not interpolated: a uniform background does not move a spot, nor does its place on the pixels, and
the noise of the pixels gives the error bars.
"""

import math
from typing import NamedTuple, TypeVar

import numpy as np
import scipy  # which loads its parts when they are used
from numpy.typing import NDArray

from reconstruction.arrays import Booleans, Floats, Image, median
from reconstruction.displacement import Displacement, LensletStatus, RegistrationMethod
from reconstruction.errors import ReconstructionError
from reconstruction.frame.bad_pixels import repaired
from reconstruction.frame.spline import interpolate, noise_power
from reconstruction.geometry import Field, centered_steps, require
from reconstruction.modes.field_modes import FieldModes, LegendreModes, SampledModes
from reconstruction.registration.subimages import DARK_CONTRAST, LensletModel, ReferenceSubimages, classify_lenslets
from reconstruction.runtime.opencv import cv2
from reconstruction.settings import RegistrationSettings

T = TypeVar("T", bound=np.generic)

_WEIGHT, _AMONG_STARS = math.sqrt(2), 1.0  # sigma of the weight over the spot's; smaller where others are near
_REACH = 4.0  # sigmas of the weight, beyond which light is left out
_COMPARED = 2.0  # sigmas of the weight, within which frame and reference are compared
_PER_BLUR, _PIXEL = 0.45, 1 / 12  # sigma of a diffraction-limited spot over its first zero; variance of a pixel
_PASSES, _SETTLED = 4, 0.01  # that measure the spots at most; relative change that ends them
_LEAST_SIGMA_PX, _MOST_SIGMA = 0.5, 1 / 6  # of spots; the latter over the distance between two
_SAMPLED_PX = 0.7  # sigma of a weight, below which sums over pixels are not its moments
_ITERATIONS, _TOLERANCE_PX, _LAST_PX = 15, 1e-4, 0.01
_FAR_PX = 3.0  # from the brightest pixel of the smoothed image, beyond which a spot is another one
_CERTAIN = 0.2  # standard error over the weight's sigma; larger ones are those of peaks of the noise
_MISFIT = 0.7  # residual over contrast above which two spots differ, noise aside
_STARLESS_FRACTION = 0.5  # of the lit lenslets; if more lack a star, the reference shows another source
_EXPECTED = 1 / 3  # of the gap between stars, within which each lies in the reference
_NEIGHBOURS, _BESIDE = 9, 1.6  # of a lenslet and with it, at most, and how many pitches away
_BEYOND = 1.5  # of the way from a lenslet to its border, up to which spots are found that their neighbours expect
_REWEIGHTINGS = 8  # of the displacements, for their trend
_AS_BRIGHT = 0.5  # of most spots, as which one counts that no neighbour expects
_TORN = 0.75  # of a cell, by which neighbours are displaced apart if one has the spot of another
_ASTRAY = 0.3  # of a cell, by which a spot may lie off where its neighbours' displacements expect it
_TINY = np.finfo(np.float32).tiny
_FITTED = 4  # numbers fitted to a spot: position, gain and offset
_ALIKE = 0.975  # correlation of the mean subimage with a spot, noise aside, above which it is one
_POINT_PX = 1.0  # half the width of a field that shows no warp
_HALOES = np.array([0.5, 1.0, 2.0])  # sigmas of the Gaussians of a spot over its own


def prepare(
    reference: ReferenceSubimages, settings: RegistrationSettings, field: Field, _model: LensletModel | None
) -> RegistrationMethod:
    """Prepare the method `centroids` for those stars of the settings that lie in the field."""
    spacing = settings.star_spacing_m / field.half_width_m
    x, y = (centered_steps(count) * spacing for count in (settings.star_columns, settings.star_rows))
    try:
        return Centroids(reference, star_x=x[np.abs(x) <= 1], star_y=y[np.abs(y) <= 1])
    except ValueError as error:
        raise ReconstructionError(f"registration.star_spacing_m does not suit the lenslets: {error}") from error


def spot_sigma_px(reference: ReferenceSubimages) -> float:
    """Sigma of the spots if each lit lenslet of a reference shows a single one; else 0.

    Of a field that the lenslets do not resolve, any image is a spot: it shows no warp.
    """
    try:
        found = Centroids(reference, star_x=np.zeros(1), star_y=np.zeros(1))
    except (ReconstructionError, ValueError):
        return 0.0
    is_point = reference.half_width_px < max(reference.blur_px / 2, _POINT_PX)
    return found.sigma_px if is_point or found.likeness() > _ALIKE else 0.0


class _Spots(NamedTuple):
    """Spots of an image, K = L lenslets x S stars."""

    position_px: Floats  # on the camera, (K, xy)
    corner: NDArray[np.intp]  # first pixel of the stamp, (K, xy)
    stamp: Floats  # light of the pixels about each spot, (K, n, n)
    curvature: Floats  # of the smoothed image at its peak; without background and noise, (K, xy, xy)
    is_peak: Booleans  # it is one, near where it was looked for, (K,)

    @property
    def brightness(self) -> Floats:
        """Mean curvature, counts: no background changes it, (K,)."""
        return np.asarray(np.trace(self.curvature, axis1=1, axis2=2) / 2)


class Centroids:
    """Registration by spots, whose size and positions in the reference are found when prepared."""

    def __init__(self, reference: ReferenceSubimages, *, star_x: Floats, star_y: Floats) -> None:
        """Prepare for stars at all star_x (column,) and star_y (row,), normalised and ascending.

        A single star may lie anywhere in its cell. `ReconstructionError` if the reference shows no stars.
        """
        for name, position in (("star_x", star_x), ("star_y", star_y)):
            is_inside = position.size > 0 and bool(np.all(np.abs(position) <= 1))
            require({f"{name} must lie in the field, -1 ... 1": is_inside})
        gaps_px = np.concatenate([np.diff(star_x), np.diff(star_y)]) * reference.half_width_px
        self._gap_px = float(gaps_px.min(initial=reference.side_px))  # between two spots
        are_apart = self._gap_px >= max(reference.blur_px, 2)
        require({"stars must lie at least two pixels' and a lenslet's blur apart": are_apart})
        self._reference = reference
        sampled = SampledModes(star_x, star_y)
        self._modes: FieldModes = LegendreModes(1) if sampled.count == 1 else sampled
        self._weight = _WEIGHT if sampled.count == 1 else _AMONG_STARS
        self._nominal_px = np.stack(sampled.nodes, axis=-1) * reference.half_width_px  # lattice frame, (S, xy)
        # Borders, 1/px, (border, xy): a single spot may use all of its cell, where no other lenslet is nearer.
        width, height = reference.cell_px
        beside = [(width, 0.0), (0.0, height)]  # neighbours
        if reference.sensor.arrangement == "hexagonal":
            beside = [(width, 0.0), (width / 2, height), (-width / 2, height)]
        to_px = np.array(beside)
        halfway = 2 * to_px / np.sum(to_px**2, axis=1, keepdims=True)
        self._borders = halfway if sampled.count == 1 else np.eye(2) / reference.reach_px
        # Whole-pixel shifts (C, xy) that leave all stars inside the cell, and where these lie then, (L, C, S).
        along = np.arange(-int(width), int(width) + 1.0)
        shifts_px = np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)
        left = 1 - np.abs(self._nominal_px @ self._borders.T).max(axis=0) - np.hypot(*self._borders.T) / 2
        inside = np.all(np.abs(shifts_px @ self._borders.T) <= left, axis=1)
        self._shifts_px = shifts_px[inside | ~shifts_px.any(axis=1)]
        self._places = self._index(self._on_camera(self._shifts_px[:, None] + self._nominal_px))

        self.sigma_px = max(math.hypot(_PER_BLUR * reference.blur_px, math.sqrt(_PIXEL)), _LEAST_SIGMA_PX)
        for _ in range(_PASSES):
            self._spots = self._find(reference.image, self._brightest(reference.image, is_reference=True))
            before_px, self.sigma_px = self.sigma_px, self._measured_sigma_px()
            if math.isclose(before_px, self.sigma_px, rel_tol=_SETTLED):
                break
        self._spots = self._find(reference.image, self._brightest(reference.image, is_reference=True))
        lit = np.repeat(reference.lit, len(self._nominal_px))
        self._faintest = DARK_CONTRAST * median(self._spots.brightness[lit])
        self._known = self._spots.is_peak & (self._spots.brightness > self._faintest)
        self._known &= self._range_used(self._spots) <= 1
        if len(self._nominal_px) > 1:
            off_px = self._spots.position_px - self._on_camera(self._nominal_px).reshape(-1, 2)
            self._known &= np.abs(off_px).max(axis=1) < _EXPECTED * self._gap_px
        if not np.mean(self._by_lenslet(self._known)[reference.lit].all(axis=1)) > 1 - _STARLESS_FRACTION:
            raise ReconstructionError("the reference shows no stars where they are expected: is the pinhole mask in?")
        self._covariance = self._of_noise(self._spots)
        tree, farthest_px = scipy.spatial.KDTree(reference.center_px), _BESIDE * reference.pitch_px
        _, near = tree.query(reference.center_px, _NEIGHBOURS, distance_upper_bound=farthest_px)
        self._beside = np.asarray(near)[:, 1:]  # numbers of the neighbours, L where there is none, (L, n)
        x, y = (reference.center_px / reference.center_px.max()).T
        self._trends = np.column_stack([np.ones_like(x), x, y, x * x, x * y, y * y])

    def __call__(self, light: Image, *, saturated: Booleans, start: Displacement | None = None) -> Displacement:  # noqa: ARG002 - each frame is searched anew
        """Register a frame; see `displacement.RegistrationMethod`. A lenslet is lost with any of its stars."""
        reference, before = self._reference, self._spots
        image, astray = repaired(light, reference.bad), np.zeros(len(before.is_peak), np.bool_)
        after = self._find(image, self._brightest(image))
        if len(self._nominal_px) == 1:
            after, astray = self._among_neighbours(image, after)
        misfit, of_residual = self._compared(after)
        covariance = of_residual
        if reference.noise is not None:
            covariance = self._of_noise(after) + self._covariance / reference.reference_frames
        error_px = np.sqrt(np.maximum(np.trace(covariance, axis1=1, axis2=2) / 2, 0))
        is_certain = after.is_peak & (error_px < _CERTAIN * self._weight * self.sigma_px)
        found = is_certain & self._known & (misfit < _MISFIT)
        range_used = self._range_used(after) * found
        if len(self._nominal_px) == 1:
            range_used = np.where(~astray & (range_used < _BEYOND), np.minimum(range_used, 1), range_used)
            range_used[self._are_torn(after, found & ~astray)] = _BEYOND
        found &= ~astray | (range_used > 1)

        lenslets, stars = len(reference.lit), len(self._nominal_px)
        displacement = (after.position_px - before.position_px) @ reference.turn.T
        covariance = (reference.turn @ covariance @ reference.turn.T).reshape(lenslets, stars, 2, 2)
        misfit = np.sqrt(np.mean(self._by_lenslet(misfit) ** 2, axis=1))
        return classify_lenslets(
            reference,
            self._modes,
            np.swapaxes(displacement.reshape(lenslets, stars, 2), 1, 2),
            covariance=np.einsum("lsab,st->lsatb", covariance, np.eye(stars)),
            residual_rms=misfit * reference.contrast / reference.contrast.max(),
            contrast=self._by_lenslet(after.brightness * is_certain).min(axis=1),
            faults={
                LensletStatus.DIVERGED: np.any(~self._by_lenslet(found), axis=1),
                LensletStatus.SATURATED: reference.touched(saturated),
            },
            range_used=np.max(self._by_lenslet(range_used), axis=1),
        )

    def _among_neighbours(self, image: Image, spots: _Spots) -> tuple[_Spots, Booleans]:
        """Look again for single spots that lie far from where those of neighbours expect them.

        If there is one, perhaps beyond its cell, it is taken. If not, a bright spot in the cell that no other lenslet
        has is right all the same; others are lost, which the second result says, (L,).
        """
        before_px, most_px = self._spots.position_px, _ASTRAY * self._reference.side_px
        likely = spots.is_peak & self._known
        usual = median(spots.brightness[likely]) if likely.any() else 0.0
        likely &= spots.brightness > DARK_CONTRAST * usual
        expected_px = self._expected_px(spots.position_px - before_px, likely)
        astray = np.hypot(*(spots.position_px - expected_px).T) > most_px
        if not np.any(astray & self._known):
            return spots, astray
        near_px = self._brightest(image, near_px=expected_px[:, None])
        again = self._find(image, np.where(astray[:, None, None], near_px, spots.position_px[:, None]))
        is_there = again.is_peak & (np.hypot(*(again.position_px - expected_px).T) <= most_px)
        is_there &= again.brightness > DARK_CONTRAST * usual
        pairs = zip(again, spots, strict=True)
        spots = _Spots(*(np.where(is_there.reshape(-1, *(1,) * (one.ndim - 1)), one, two) for one, two in pairs))
        is_bright = spots.is_peak & (spots.brightness > _AS_BRIGHT * usual)
        away_px, _ = scipy.spatial.KDTree(spots.position_px[is_bright | is_there]).query(spots.position_px, 2)
        is_alone = np.asarray(away_px)[:, 1] > most_px
        return spots, ~is_there & ~(is_bright & is_alone & (self._range_used(spots) <= 1))

    def _are_torn(self, spots: _Spots, found: Booleans) -> Booleans:
        """True for found spots that lie too far from those of a neighbour: one of both is of another lenslet, (L,)."""
        moved_px = np.full((len(found) + 1, 2), np.nan)
        moved_px[:-1][found] = (spots.position_px - self._spots.position_px)[found]
        apart_px = np.hypot(*np.moveaxis(moved_px[:-1, None] - moved_px[self._beside], -1, 0))
        return np.asarray(np.any(apart_px > _TORN * self._reference.side_px, axis=1))

    def _expected_px(self, moved_px: Floats, likely: Booleans) -> Floats:
        """Positions on the camera (L, xy) that the displacements of `likely` neighbours expect, (L, xy).

        That is their median about the trend of all, without those in the cells of others, which lie far from it.
        """
        if np.count_nonzero(likely) < 2 * self._trends.shape[1]:
            return self._spots.position_px + moved_px
        trends, weight = self._trends[likely], np.ones((np.count_nonzero(likely), 1))
        for _ in range(_REWEIGHTINGS):  # towards the least sum of distances
            weighted = (trends * weight).T  # normal equations are much faster than least squares, and good enough
            trend_px = self._trends @ np.linalg.lstsq(weighted @ trends, weighted @ moved_px[likely], rcond=None)[0]
            away_px = np.hypot(*(moved_px - trend_px).T)
            weight = 1 / np.maximum(away_px[likely, None], self.sigma_px)
        likely = likely & (away_px < self._reference.side_px / 2)
        rest_px = np.full((len(likely) + 1, 2), np.nan)
        rest_px[:-1][likely] = (moved_px - trend_px)[likely]
        near_px = np.sort(rest_px[self._beside], axis=1)  # NaN last
        middle = np.maximum(np.isfinite(near_px).sum(axis=1, keepdims=True) - 1, 0) // 2
        rest_px = np.nan_to_num(np.take_along_axis(near_px, middle, axis=1)[:, 0])
        return np.asarray(self._spots.position_px + trend_px + rest_px)

    def likeness(self) -> float:
        """Correlation of the mean subimage of the reference, each about its spot, with the spot most like it.

        A spot is a sum of concentric Gaussians: pictures have flat tops, which no sum of them has. The correlation of
        two halves of the lenslets shows the noise, whose effect is taken away.
        """
        reference, spots = self._reference, self._spots
        known = self._known & np.repeat(reference.lit, len(self._nominal_px))
        position_px = spots.position_px[known][:, None] + reference.offset_px @ reference.turn
        light, _ = interpolate(reference.spline_coefficients, position_px)
        if len(light) < 2:
            return 0.0
        light /= spots.brightness[known, None]
        away = np.sum(reference.offset_px**2, axis=1)[:, None] / self.sigma_px**2
        gaussians = np.exp(away / (-2 * _HALOES**2))
        amplitudes, _ = scipy.optimize.nnls(gaussians - gaussians.mean(axis=0), light.mean(axis=0) - light.mean())
        spot = gaussians @ amplitudes
        of_one, of_other, alike = np.corrcoef([light[::2].mean(axis=0), light[1::2].mean(axis=0), spot])[
            [0, 1, 0], [2, 2, 1]
        ]
        return float(math.sqrt(max(of_one * of_other / alike, 0.0)) if alike > 0 else 0.0)

    def _by_lenslet(self, values: NDArray[T]) -> NDArray[T]:
        """Values of the spots (K,) by lenslet and star, (L, S)."""
        return values.reshape(len(self._reference.lit), -1)

    def _on_camera(self, position_px: Floats) -> Floats:
        """Camera positions of positions (..., xy) about each lenslet along the lattice, (L, ..., xy)."""
        reference = self._reference
        center_px = reference.center_px.reshape(-1, *(1,) * (position_px.ndim - 1), 2)
        return np.asarray(center_px + position_px @ reference.turn)

    def _index(self, position_px: Floats) -> NDArray[np.intp]:
        """Number of the nearest pixel, row by row, to camera positions (..., xy)."""
        rows, columns = self._reference.image.shape
        column, row = np.moveaxis(np.rint(position_px).astype(np.intp), -1, 0)
        return np.asarray(np.clip(row, 0, rows - 1) * columns + np.clip(column, 0, columns - 1))

    def _find(self, image: Image, near_px: Floats) -> _Spots:
        """Find the spots of an image (row, column), the peaks of the smoothed image near (L, S, xy), by Newton's."""
        sigma_px = self._weight * self.sigma_px
        start = np.rint(near_px.reshape(-1, 2)).astype(np.intp)
        half = math.ceil(min(_REACH * sigma_px + _FAR_PX, self._gap_px))
        corner, steps = start - half, np.arange(2 * half + 1)
        column, row = np.moveaxis(corner[..., None] + steps, 1, 0)  # (K, n)
        inside = [(at >= 0) & (at < size) for at, size in ((row, image.shape[0]), (column, image.shape[1]))]
        pixel = np.where(inside[0], row, 0)[:, :, None], np.where(inside[1], column, 0)[:, None]
        stamp = image[pixel].astype(np.float64) * (inside[0][:, :, None] & inside[1][:, None])
        position_px = start.astype(np.float64)
        for _ in range(_ITERATIONS):
            moments = _moments(stamp, position_px - corner, sigma_px**2)
            curvature = _curvature(moments, sigma_px**2)
            slope = np.stack([moments[:, 0, 1], moments[:, 1, 0]], axis=-1)
            inverse, is_peak = _inverse(curvature)
            uphill = slope / np.maximum(np.abs(moments[:, :1, 0]), _TINY)
            step_px = np.where(is_peak[:, None], (inverse @ slope[..., None])[..., 0], uphill).clip(-1, 1)
            position_px = position_px + step_px
            largest_px = np.abs(step_px).max(axis=1)
            if not np.any(is_peak & (largest_px > _TOLERANCE_PX)):
                break
        is_near = np.abs(position_px - start).max(axis=1) < _FAR_PX
        position_px = np.where(is_near[:, None], position_px, start)
        return _Spots(position_px, corner, stamp, curvature, is_peak & is_near & (largest_px < _LAST_PX))

    def _brightest(self, image: Image, *, is_reference: bool = False, near_px: Floats | None = None) -> Floats:
        """Brightest places of the smoothed image in each cell, or near (L, S, xy), on the camera, (L, S, xy)."""
        smooth = cv2.GaussianBlur(image, (0, 0), self._weight * self.sigma_px).ravel()
        stars, half = self._nominal_px, int(_ASTRAY * self._reference.side_px)
        if near_px is None:
            shift_px = np.zeros((len(self._places), 2))
            if len(stars) == 1 or not is_reference:  # a grid of stars is not displaced there
                shift_px = self._shifts_px[smooth[self._places].sum(axis=2).argmax(axis=1)]
            near_px = self._reference.center_px[:, None] + (shift_px[:, None] + stars) @ self._reference.turn
            if len(stars) == 1:
                return near_px
            half = max(int(self._gap_px / 2) - 1, 1)
        around = np.stack(np.meshgrid(*[np.arange(-half, half + 1.0)] * 2), axis=-1).reshape(-1, 2)
        return np.asarray(near_px + around[smooth[self._index(near_px[:, :, None] + around)].argmax(axis=2)])

    def _measured_sigma_px(self) -> float:
        """Median sigma of the lit spots of the reference, by moments with a weight as wide as they seemed."""
        spots, variance = self._spots, max(self.sigma_px, _SAMPLED_PX) ** 2
        known = spots.is_peak & np.repeat(self._reference.lit, len(self._nominal_px))
        stamp = spots.stamp[known]
        if not len(stamp):
            return self.sigma_px
        half = stamp.shape[-1] // 2
        away_px = np.abs(np.indices(stamp.shape[1:]) - half).max(axis=0)
        border = stamp[:, away_px == min(half, round(self._gap_px / 2))]  # halfway to the next spot
        stamp = stamp - np.median(border, axis=1)[:, None, None]
        moments = _moments(stamp, (spots.position_px - spots.corner)[known], variance)
        with np.errstate(divide="ignore", invalid="ignore"):
            weighted = (moments[:, 0, 2] + moments[:, 2, 0]) / (
                2 * moments[:, 0, 0]
            )  # 1 / weighted = 1 / spot + 1 / weight
            found = 1 / (1 / weighted - 1 / variance)
        found = np.where((weighted > 0) & (weighted < variance), found, np.inf)
        return float(np.clip(math.sqrt(median(found)), _LEAST_SIGMA_PX, _MOST_SIGMA * self._gap_px))

    def _range_used(self, spots: _Spots) -> Floats:
        """Distance of spots from their lenslet over the farthest in its cell, (K,)."""
        center_px = np.repeat(self._reference.center_px, len(self._nominal_px), axis=0)
        away_px = (spots.position_px - center_px) @ self._reference.turn.T
        return np.asarray(np.abs(away_px @ self._borders.T).max(axis=1))

    def _of_noise(self, spots: _Spots) -> Floats:
        """Covariance of the positions of spots by the camera's noise in one frame, px^2, (K, xy, xy)."""
        noise = self._reference.noise
        if noise is None:
            return np.zeros((len(spots.stamp), 2, 2))
        variance = noise.counts_per_light * spots.stamp + noise.read_noise_counts**2
        return self._propagated(variance, spots.position_px - spots.corner, spots.curvature)

    def _propagated(self, variance: Floats, at_px: Floats, curvature: Floats) -> Floats:
        """Covariance of positions at_px (K, xy) in stamps of that variance of the pixels (K, n, n), (K, xy, xy)."""
        moments = _moments(variance, at_px, (self._weight * self.sigma_px) ** 2 / 2)  # with the square of the weight
        slopes = np.stack([moments[:, [0, 1], [2, 1]], moments[:, [1, 2], [1, 0]]], axis=1)
        inverse, _ = _inverse(curvature)
        return np.asarray(inverse @ slopes @ inverse)

    def _compared(self, after: _Spots) -> tuple[Floats, Floats]:
        """Residual of spots over their contrast (K,), noise aside; covariance by it if noise is unknown (K, xy, xy)."""
        reference, before, sigma_px = self._reference, self._spots, self._weight * self.sigma_px
        width = after.stamp.shape[1]
        left_out = width // 2 - min(math.ceil(_COMPARED * sigma_px), width // 2)
        middle = slice(left_out, width - left_out)
        stamp, corner = after.stamp[:, middle, middle], after.corner + left_out
        at_px, steps = after.position_px - corner, np.arange(stamp.shape[1])
        x, y = np.moveaxis((corner - after.position_px + before.position_px)[..., None] + steps, 1, 0)
        still, _ = interpolate(
            reference.spline_coefficients, np.stack(np.broadcast_arrays(x[:, None], y[:, :, None]), axis=-1)
        )
        along_x, along_y = np.moveaxis(np.exp((steps - at_px[..., None]) ** 2 / (-2 * sigma_px**2)), 1, 0)
        weight = along_y[:, :, None] * along_x[:, None]
        weight /= weight.sum(axis=(1, 2), keepdims=True)

        def mean(values: Floats) -> Floats:
            return np.asarray(np.sum(weight * values, axis=(1, 2), keepdims=True))

        stamp_away, still_away = stamp - mean(stamp), still - mean(still)
        gain = mean(stamp_away * still_away) / np.maximum(mean(still_away**2), _TINY)
        residual = stamp_away - gain * still_away
        square = mean(residual**2)
        of_residual = np.zeros((len(stamp), 2, 2))
        if reference.noise is None:
            free = 1 / np.sum(weight**2, axis=(1, 2), keepdims=True)  # independent pixels
            left = noise_power(before.position_px - after.position_px)[:, None, None]  # by interpolation
            taken = (1 + 1 / reference.reference_frames) / (1 + left / reference.reference_frames)
            of_residual = self._propagated(residual**2 * taken * free / (free - _FITTED), at_px, after.curvature)
        else:
            expected = reference.noise.counts_per_light * mean(stamp) + reference.noise.read_noise_counts**2
            square = square - expected * (1 + gain / reference.reference_frames)
        misfit = np.sqrt(np.maximum(square, 0) / np.maximum(mean(stamp_away**2), _TINY)).ravel()
        return misfit, of_residual


def _moments(image: Floats, at_px: Floats, variance: float) -> Floats:
    """Moments y^a x^b of stamps (K, n, n), weighted by a Gaussian about positions (K, xy): (K, a, b), a and b <= 2."""
    from_px = np.arange(image.shape[-1]) - at_px[..., None]  # (K, xy, n)
    weight = np.exp(from_px**2 / (-2 * variance))
    along_x, along_y = np.moveaxis(np.stack([weight, from_px * weight, from_px**2 * weight], axis=2), 1, 0)
    return np.asarray(along_y @ image @ np.swapaxes(along_x, 1, 2))


def _curvature(moments: Floats, variance: float) -> Floats:
    """Negative second derivatives of the smoothed image, times the weight's variance, (K, xy, xy)."""
    xx, yy = (moments[:, 0, 0] - each / variance for each in (moments[:, 0, 2], moments[:, 2, 0]))
    xy = -moments[:, 1, 1] / variance
    return np.moveaxis(np.array([[xx, xy], [xy, yy]]), -1, 0)


def _inverse(matrix: Floats) -> tuple[Floats, Booleans]:
    """Inverse of symmetric matrices (K, 2, 2), and whether they are positive definite, (K,); elsewhere 0."""
    (xx, xy), (_, yy) = np.moveaxis(matrix, 0, -1)
    determinant = xx * yy - xy**2
    is_positive = (determinant > 0) & (xx > 0)
    adjugate = np.moveaxis(np.array([[yy, -xy], [-xy, xx]]), -1, 0)
    return adjugate * np.where(is_positive, 1 / np.where(is_positive, determinant, 1), 0)[:, None, None], is_positive
