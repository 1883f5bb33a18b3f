"""Quality of frames measured against one reference, by their reconstruction and some pixels.

Valid lenslets do not make a wavefront true. A blurred or doubled image, or one with wrong grey values, matches after a
wrong warp, but not well; a torn or turned frame matches well, but with slopes that belong to no wavefront.

Strong aberrations leave a misfit, too, because a warp does not describe diffraction. It grows with the deformation that
is found, so that limits are shares of it, above the noise (evidence/quality.md).

Uniform stray light does no harm. A rise within a subimage looks like a change of its size; the same rise in all
lenslets looks like a sample near the source. It is measured between the openings, where a wavefront moves little light.
"""

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy import spatial

from reconstruction.arrays import Booleans, Counts, Floats
from reconstruction.displacement import Displacement, LensletStatus
from reconstruction.frame.linearity import LINEAR
from reconstruction.frame.pixels import (
    BACKGROUND_PERCENT,
    CLIPPED,
    TOO_BRIGHT,
    UNKNOWN_CAMERA,
    KnownCamera,
    Samples,
    clipped_fraction,
    collect,
    compiled_counts,
)
from reconstruction.geometry import Sensor, lenslet_centers
from reconstruction.modes.field_modes import PolynomialModes
from reconstruction.modes.polynomials import number_up_to
from reconstruction.modes.pupil_modes import pupil_modes
from reconstruction.quality.lenslet_shift import FEWEST, LensletShift
from reconstruction.quality.verdict import NO_FAULT, Fault, Quality
from reconstruction.registration.subimages import ReferenceSubimages
from reconstruction.settings import RegistrationSettings, Warp


class _Limits(NamedTuple):
    """Limits above which a misfit is no effect of the warp, or noise hides it."""

    pixels: float  # residual over the reference's contrast, per px of deformation within a subimage
    slopes: float  # misfit of the slopes over the displacement
    reference_noise: float  # variance of the reference over the square of its gradient, per px


_LIMITS: dict[Warp, _Limits] = {
    "translation": _Limits(0.0, 0.1, 0.06),
    "affine": _Limits(0.25, 0.06, 0.06),
    "quadratic": _Limits(0.055, 0.03, 0.06),
    "cubic": _Limits(0.04, 0.03, 0.06),
    "quartic": _Limits(0.03, 0.03, 0.015),
}
_OPENING = 0.35  # RMS gradient over contrast, 1/px: squares and circles have less, points more
_POINTS = 0.25  # by which the first limit rises with what is beyond: no warp describes how points blur
_LEAST_MISFIT = 0.015  # residual over contrast; uneven pixels of 1 % cause as much
_LEAST_SLOPES_PX = 0.01
_NOISE_PIXELS = 1.3  # of the expected variance, not counted as misfit
_NOISE_SLOPES = 5.0  # the same; a quartic warp scatters up to 4 times as expected at 200 electrons
_UNLIKE = 0.25  # share of lenslets without a match
_LEFT = 0.1  # share of lenslets that left their cells
_SATURATED = 0.1  # share of lenslets with pixels at full scale
_BLOCKED = 0.1  # share of the reference's lit lenslets that are dark
_UNEVEN = 2.0  # factor by which the light of a lenslet, over that of most, may differ from the reference's
_DIM = 0.01  # of the reference's light; below, what remains may be stray light
_STRAY = 0.006  # rise of stray light from lenslet to lenslet, over the brightest; it adds 0.03 rad
_STRAY_SHARE = 0.03  # the same per px of deformation: subimages that grow across the pupil fill their gaps
_SPOTS, _SPOTS_SHARE = 0.012, 0.01  # the same for its RMS change between neighbours, and per px of their displacements
_STEP_PX = 2  # between the pixels that are looked at, along each axis; 1 where a point's image is narrower
_ACROSS = np.linspace(-0.8, 0.8, 5)  # normalised field positions at which deformation is taken
_MODES_SHARE, _MOST_DEGREE = 0.36, 16  # modes of a smooth wavefront over the number of slopes, and their degree
_TILE = 16  # lenslets a side whose slopes are judged together
_LEAST_SIDE, _LEAST_LENSLETS = 4, 25  # fewer sample a smooth wavefront too coarsely: right frames would be flagged
_FEW_LENSLETS = "slopes are not checked: the lattice has too few lenslets"


class QualityChecker:
    """Judges frames measured against one reference."""

    def __init__(
        self,
        reference: ReferenceSubimages,
        settings: RegistrationSettings,
        *,
        camera: KnownCamera = UNKNOWN_CAMERA,
        of_reference: Quality = NO_FAULT,
    ) -> None:
        """Prepare; `of_reference` is the reference's own quality, which all its frames share."""
        self._sensor, field = reference.sensor, reference.field
        self._linearity, self._noise, self.of_reference = camera.linearity, reference.noise, of_reference
        warp = (settings.warp or "quartic") if settings.fits_warps else "translation"
        self._limits, has_limit = _LIMITS[warp], warp != "translation"
        if has_limit:
            points = _POINTS * max(_sharpness(reference) - _OPENING, 0.0)
            self._limits = self._limits._replace(pixels=self._limits.pixels + points)
        self._knows_misfit = has_limit and reference.noise is not None
        self._tiles = list(_tiles(reference.lenslets))
        enough = _enough_frames(reference, self._limits.reference_noise)
        is_noisy = enough > reference.reference_frames
        self._unjudged = "; ".join(self._not_judged(has_limit=has_limit, needed_frames=enough if is_noisy else None))
        if is_noisy:
            self._tiles = []
        self._lit = reference.lit.reshape(reference.lenslets)
        self._half_width_px, self._neglects = reference.half_width_px, field.neglect_propagation
        # The light of lenslets holds no period shorter than the blur: a finer grid sees all of it.
        step = min(max(int(reference.blur_px), 1), _STEP_PX)
        columns, window = reference.bad.shape[1], (-1, reference.width, reference.width)
        nearest = np.rint(reference.position_px[reference.lit]).astype(np.int32) @ np.array([1, columns], np.int32)
        pixel = nearest.reshape(window)[:, ::step, ::step].reshape(len(nearest), -1)  # (lit lenslet, sample)
        is_good = ~reference.bad.ravel()[pixel]
        light = reference.light[reference.lit].reshape(window)[:, ::step, ::step].reshape(pixel.shape)
        self._light = np.sum(light * is_good, axis=1)
        self._grid = np.stack(np.meshgrid(_ACROSS, _ACROSS), axis=-1).reshape(-1, 2)
        self._grid = self._grid[field.contains(*self._grid.T)]
        self._values: Floats | None = None  # of the field modes there, (field_mode, position), at the first frame
        self._noise_slopes = _NOISE_SLOPES * (1 + 1 / reference.reference_frames)  # its noise is not in the variance
        self._knows_dark = camera.dark is not None
        dark = np.zeros(pixel.shape) if camera.dark is None else np.asarray(camera.dark, np.float64).ravel()[pixel]
        self._stray = StrayLight(self._sensor, lit=self._lit, light=light, is_good=is_good)
        a_good_one = np.take_along_axis(pixel, np.argmax(is_good, axis=1)[:, None], axis=1)
        floats = (each.astype(np.float32) for each in (is_good, self._stray.gaps, dark, light + dark))
        self._samples = Samples(np.where(is_good, pixel, a_good_one), *floats)
        self._lenslet_shift, self._turn = LensletShift(reference, camera.dark), reference.turn
        self._curve = LINEAR if camera.linearity is None else camera.linearity.curve

    def _not_judged(self, *, has_limit: bool, needed_frames: int | None) -> Iterator[str]:
        """Say what is not checked, and why; `needed_frames` to average if the reference is too noisy."""
        if not has_limit:
            yield "misfit is not checked: it has no limit for this registration"
        elif not self._knows_misfit:
            yield "misfit is not checked: the noise of the images is unknown"
        if not self._tiles:
            yield _FEW_LENSLETS
        if needed_frames is not None:
            yield f"slopes are not checked: the reference is noisy: average at least {needed_frames} frames"

    def __call__(self, frame: Counts, displacement: Displacement) -> Quality:
        """Judge a frame (row, column), counts, by its displacements."""
        reasons = dict(self._of_matches(displacement)) | dict(self._of_pixels(frame, displacement))
        if np.count_nonzero(self._lit & ~displacement.valid) >= FEWEST:  # those that the light has left
            measured_px = displacement.coefficients[displacement.valid][:, 0] @ self._turn
            middle_px = np.median(measured_px, axis=0) if len(measured_px) else np.zeros(2)
            moved_px = self._lenslet_shift(frame, middle_px)
            if moved_px.any():
                x, y = np.rint(moved_px).astype(int)
                reasons[Fault.RANGE] = (
                    f"the lenslets with light are displaced by ({x:+d}, {y:+d}) px: images lie in the"
                    " cells of other lenslets; move the frame back by as much, or take a reference in this position"
                )
        return Quality(reasons, self._unjudged) | self.of_reference

    def _of_matches(self, displacement: Displacement) -> Iterator[tuple[Fault, str]]:
        """Faults seen in the outcomes of the lenslets, their residuals and their slopes."""
        counts = np.bincount(displacement.outcome[self._lit], minlength=len(LensletStatus)).tolist()
        unlike, left, dark = counts[LensletStatus.DIVERGED], counts[LensletStatus.LEFT_CELL], counts[LensletStatus.DARK]
        saturated = counts[LensletStatus.SATURATED]
        lit = sum(counts)  # the others are absent
        deformation_px, spread_px = self._sizes_px(displacement)
        misfit = _misfit(displacement) if self._knows_misfit else 0.0
        if unlike > _UNLIKE * lit:
            yield Fault.MISFIT, f"{unlike} of {lit} subimages do not match the reference: {_LOOK}"
        elif misfit > math.hypot(_LEAST_MISFIT, self._limits.pixels * deformation_px):
            differ = f"differ from the reference's by {100 * misfit:.0f} % of the contrast"
            yield Fault.MISFIT, f"the subimages {differ}: {_LOOK}"
        slopes_px = self._slope_misfit_px(displacement, displacement.mean_variance)
        limit_px = math.hypot(_LEAST_SLOPES_PX, self._limits.slopes * math.hypot(deformation_px, spread_px))
        if slopes_px > limit_px:  # their own variance takes longer to compute
            slopes_px = self._slope_misfit_px(displacement, displacement.variance[:, :, 0].mean(axis=-1))
        if slopes_px > limit_px:
            moved = "the camera may have turned, or the frame is torn or half a pitch off; take a new reference (R)"
            yield Fault.SLOPES, f"slopes differ from those of any wavefront by {slopes_px:.2f} px: {moved}"
        if saturated > _SATURATED * lit:
            yield Fault.CLIPPED, f"{saturated} of {lit} lenslets are saturated: {TOO_BRIGHT}"
        if left > _LEFT * lit:
            yield Fault.RANGE, f"{left} of {lit} subimages have left their cells: the aberration is too strong"
        if dark > _BLOCKED * lit:
            are_dark = "are dark, but bright in the reference: find what blocks the light"
            yield Fault.ILLUMINATION, f"{dark} of {lit} lenslets {are_dark}"

    def _of_pixels(self, frame: Counts, displacement: Displacement) -> Iterator[tuple[Fault, str]]:
        """Faults seen in some pixels of a frame (row, column), counts, with these displacements."""
        counts, brightest, light, added = self._collected(frame)
        whole = max(float(light.sum()), np.finfo(np.float64).tiny)
        ratio = light * (self._light.sum() / whole) / self._light
        uneven = np.count_nonzero((ratio > _UNEVEN) | (ratio * _UNEVEN < 1))
        share = max(float(light.sum()), 0.0) / float(self._light.sum())
        if share < _DIM:
            dimmed = "check the light and its current"
            yield Fault.ILLUMINATION, f"the frame has only {100 * share:.2g} % of the reference's light: {dimmed}"
        elif uneven > _BLOCKED * ratio.size:
            change = f"relative to the others, by more than a factor of {_UNEVEN:g} since the reference"
            yield Fault.ILLUMINATION, f"the light of {uneven} lenslets has changed, {change}"
        elif (rise := self._stray_light(added, displacement)) > 0:
            change = f"by {100 * rise:.1f} % of the brightest pixels from lenslet to lenslet"
            yield Fault.ILLUMINATION, f"stray light rises across the frame, {change}: cover the setup"
        else:
            at = displacement, self._lit, ratio, self._half_width_px
            yield from propagation_faults(*at, neglect_propagation=self._neglects)
        scatter = read_noise = 0.0
        if self._noise is not None:
            scatter = math.sqrt(self._noise.variance(np.array(brightest)).item())
            read_noise = self._noise.read_noise_counts
        clipped = clipped_fraction(counts, scatter=scatter, read_noise=read_noise)
        if clipped > CLIPPED:
            yield Fault.CLIPPED, f"{100 * clipped:.0f} % of the pixels are clipped: {TOO_BRIGHT}"

    def _stray_light(self, added: Floats, displacement: Displacement) -> float:
        """Rise of stray light from lenslet to lenslet, over the brightest; 0 if a wavefront may explain it."""
        rise, spots = self._stray.rise(added), self._stray.spots(added)
        if rise <= _STRAY and spots <= _SPOTS:
            return 0.0
        deformation_px, spread_px = self._sizes_px(displacement)
        share = _STRAY_SHARE * deformation_px
        is_spotted = spots > math.hypot(_SPOTS, share, _SPOTS_SHARE * spread_px)
        return max(rise * (rise > math.hypot(_STRAY, share)), spots * is_spotted)

    def _collected(self, frame: Counts) -> tuple[Counts, float, Floats, Floats]:
        """Counts of the samples, the brightest signal, and sums over lit lenslets: light, and excess in the gaps."""
        pixels, shape = compiled_counts(frame).reshape(-1), self._samples.pixel.shape
        background = 0.0 if self._knows_dark else np.percentile(pixels[self._samples.pixel], BACKGROUND_PERCENT)
        counts, signals, sums = np.empty(shape, pixels.dtype), np.empty(shape, np.float32), np.empty((2, shape[0]))
        collect(pixels, self._samples, (np.float32(background), self._curve), counts, signals, sums)
        return counts, float(signals.max(initial=-np.inf)), sums[0], sums[1]

    def _sizes_px(self, displacement: Displacement) -> tuple[float, float]:
        """RMS deformation of the subimages, and RMS scatter of their mean displacements, px."""
        coefficients = displacement.coefficients[displacement.valid]  # (lenslet, field_mode, xy)
        if not len(coefficients):
            return 0.0, 0.0
        mean = coefficients[:, 0]
        if self._values is None or len(self._values) != displacement.modes.count:
            self._values = displacement.modes.values(*self._grid.T)
        deformation = np.swapaxes(coefficients[:, 1:], 1, 2).reshape(2 * len(mean), -1) @ self._values[1:]
        away = mean - mean.mean(axis=0)
        return _rms(deformation), _rms(away)

    def _slope_misfit_px(self, displacement: Displacement, variance: Floats) -> float:
        """RMS misfit of the mean displacements to the best smooth wavefront, beyond the noise, px.

        `variance` (lenslet_row, lenslet_column) of the mean displacements, px^2.
        """
        square = freedom = 0.0
        all_valid = displacement.valid
        for tile in self._tiles:
            valid = all_valid[tile]
            data = displacement.coefficients[tile][valid][:, 0].ravel()
            basis = _gradients(self._sensor, *valid.shape, valid.tobytes())
            if basis.shape[0] > basis.shape[1]:
                misfit = data - basis @ (basis.T @ data)
                free = basis.shape[0] - basis.shape[1]
                square += float(misfit @ misfit) - self._noise_slopes * free * float(np.mean(variance[tile][valid]))
                freedom += free
        return math.sqrt(max(square / freedom, 0.0)) if freedom else 0.0


_LOOK = "check the mask and the focus, then take a new reference (R)"


def _sharpness(reference: ReferenceSubimages) -> float:
    """RMS gradient of lit subimages over contrast, 1/px: 0.31 for the paper's square, 1.04 for its stars."""
    lit = reference.lit
    square = np.mean(np.sum(reference.gradient[lit] ** 2, axis=-1)) / np.mean(reference.contrast[lit] ** 2)
    return math.sqrt(float(square))


def _enough_frames(reference: ReferenceSubimages, most_noise: float) -> int:
    """Number of averaged frames from which on noise of the reference distorts no displacements."""
    if reference.noise is None:
        return 0
    variance = reference.noise.variance(np.maximum(reference.light[reference.lit], 0.0))
    square = np.mean(np.sum(reference.gradient[reference.lit] ** 2, axis=-1))
    return math.ceil(float(np.mean(variance) / square) / most_noise)


def _rms(vectors: Floats) -> float:
    """RMS length of vectors (x and y) given by all their components."""
    return math.sqrt(2 * float(np.vdot(vectors, vectors)) / vectors.size) if vectors.size else 0.0


def _misfit(displacement: Displacement) -> float:
    """Residual of a typical lenslet beyond its noise, over the reference's contrast."""
    known = displacement.valid & (displacement.chi_square > 0)  # 0: an image without a residual
    if not known.any():
        return 0.0
    square = displacement.residual_rms[known] ** 2 * (1 - _NOISE_PIXELS / displacement.chi_square[known])
    return math.sqrt(max(float(np.median(square)), 0.0))


def _tiles(shape: tuple[int, ...]) -> Iterator[tuple[slice, slice]]:
    """Parts of about 16 x 16 lenslets, which begin with an even row; none if lenslets are too few."""
    rows, columns = (np.linspace(0, side, -(-side // _TILE) + 1).astype(int).tolist() for side in shape)
    rows[1:-1] = [row - row % 2 for row in rows[1:-1]]
    for top, bottom in pairwise(rows):
        for left, right in pairwise(columns):
            sides = bottom - top, right - left
            if min(sides) >= _LEAST_SIDE and math.prod(sides) >= _LEAST_LENSLETS:
                yield slice(top, bottom), slice(left, right)


@lru_cache(maxsize=64)
def _gradients(sensor: Sensor, rows: int, columns: int, valid_bytes: bytes) -> Floats:
    """Orthonormal basis of the mean gradients of smooth wavefronts on lenslets, (2 * valid, n)."""
    part = replace(sensor, lenslet_rows=rows, lenslet_columns=columns)
    valid: Booleans = np.frombuffer(valid_bytes, np.bool_).reshape(rows, columns)
    most = _MODES_SHARE * 2 * np.count_nonzero(valid)
    degree = max(n for n in range(1, _MOST_DEGREE + 1) if n == 1 or number_up_to(n) <= most)
    gradients = pupil_modes(part, "legendre", number_up_to(degree)).gradients[1:, valid]  # (mode, lenslet, xy)
    basis, _ = np.linalg.qr(gradients.reshape(len(gradients), -1).T)
    return np.asarray(basis)


@lru_cache(maxsize=8)
def _growth(modes: PolynomialModes) -> Floats:
    """Relative growth of a subimage's area per displacement, normalised, (field_mode, xy)."""
    return modes.gradients(0.0, 0.0)


_BETWEEN = 0.5  # of the slope of log light over log area: 1 in real light, 0 in the paper's world
_LEAST_GROWTH = 0.002  # standard deviation of log area; less decides nothing
_CERTAIN = 5.0  # standard errors of a slope or a rise
_ALIKE = 25.0  # neighbouring lenslets, over which absorption and uneven light are alike
_MOST_NOISE = 0.3  # of the variance of log area
_REAL = "real light: remove neglect_propagation from the bench"
_NEGLECTED = "the paper's simulation: set field.neglect_propagation = true, or is the light uneven?"


def propagation_faults(
    displacement: Displacement, lit: Booleans, light: Floats, half_width_px: float, *, neglect_propagation: bool
) -> Iterator[tuple[Fault, str]]:
    """Yield a fault if the frame's light is surely of the other world than is assumed.

    `lit` (lenslet_row, lenslet_column) marks lit lenslets, `light` (lit lenslet,) is theirs over that in the reference.
    """
    known = displacement.valid[lit] & (light > 0)
    modes = displacement.modes
    if not isinstance(modes, PolynomialModes) or np.count_nonzero(known) < _LEAST_LENSLETS:
        return
    weights = _growth(modes) / half_width_px
    area = np.tensordot(displacement.coefficients[lit][known], weights, axes=2)
    area -= area.mean()
    size, count = float(area @ area), len(area)
    if size < count * _LEAST_GROWTH**2:
        return
    log_light = np.log(light[known])
    slope = float(area @ log_light) / size
    if (slope > _BETWEEN) != neglect_propagation:
        return
    left = log_light - log_light.mean() - slope * area
    sigma = math.sqrt(_ALIKE * float(left @ left) / (count - 2) / size)
    noise = float(np.sum(displacement.variance[lit][known] * weights**2)) / size  # takes longest
    if noise < _MOST_NOISE and abs(slope - _BETWEEN) > max(_CERTAIN * sigma, _MOST_NOISE):
        change, cause = ("grows", _REAL) if neglect_propagation else ("does not grow", _NEGLECTED)
        yield Fault.PROPAGATION, f"the light of the subimages {change} with their size: this is {cause}"


_GAP = 0.1  # of the brightest; darker samples lie between the openings
_FEWEST_SAMPLES, _FEWEST_LENSLETS = 4, 9
_PLANE = 3  # terms
_NEAR = 1.1  # pitches between neighbours


class StrayLight:
    """Measures the rise of stray light from lenslet to lenslet, against one reference."""

    def __init__(self, sensor: Sensor, *, lit: Booleans, light: Floats, is_good: Booleans) -> None:
        """Prepare the planes of the lenslets whose gaps are dark enough.

        Parameters
        ----------
        sensor : Sensor
        lit : (lenslet_row, lenslet_column)
        light, is_good : (lit lenslet, sample)
            Of the reference, counts above the dark; whether the sample's pixel is good.
        """
        self._brightest = float(np.max(light, initial=0.0))
        gaps = is_good & (light < _GAP * self._brightest)
        gaps[np.count_nonzero(gaps, axis=1) < _FEWEST_SAMPLES] = False
        self.gaps = gaps  # samples between the openings, (lit lenslet, sample)
        samples = np.count_nonzero(gaps, axis=1)
        self._lenslets = samples > 0
        self._samples = samples[self._lenslets]
        place = lenslet_centers(sensor.arrangement, *lit.shape)[lit][self._lenslets]  # pitches
        self._plane = np.column_stack([place, np.ones(len(place))])
        self._is_measured = len(place) >= _FEWEST_LENSLETS and np.linalg.matrix_rank(self._plane) == _PLANE
        self._inverse = np.linalg.pinv(self._plane) if self._is_measured else self._plane.T
        self._neighbours = spatial.KDTree(place).query_pairs(_NEAR, output_type="ndarray")  # (pair, 2)

    def rise(self, added: Floats) -> float:
        """Rise per pitch of a frame beyond chance, over the brightest; 0 if unknown.

        `added` (lit lenslet,) is the sum of what the samples in `gaps` have more than in the reference, counts. A plane
        is fitted by least squares to the mean of each lenslet; the scatter about it gives the standard error, as in any
        linear regression.
        """
        if not self._is_measured:
            return 0.0
        added = added[self._lenslets] / self._samples
        plane = self._inverse @ added
        scatter = float(np.sum((added - self._plane @ plane) ** 2)) / (len(added) - _PLANE)
        error = math.sqrt(scatter * float(np.max(np.sum(self._inverse[:2] ** 2, axis=1))))
        return max(math.hypot(*plane[:2]) - _CERTAIN * error, 0.0) / self._brightest

    def spots(self, added: Floats) -> float:
        """RMS change between neighbouring lenslets, over the brightest; 0 if unknown. `added` as above."""
        if not len(self._neighbours):
            return 0.0
        one, other = (added[self._lenslets] / self._samples)[self._neighbours].T
        return math.sqrt(float(np.mean((one - other) ** 2))) / self._brightest
