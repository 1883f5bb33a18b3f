"""An image without the measured aberration: deconvolved within the field, untouched beyond it.

Richardson-Lucy and Wiener both stop at the first estimate whose image differs from the measured one as the noise does
(discrepancy principle: reduced chi-square 1). Light from beyond the edge of the image is part of the unknown object, so
that edges do not ring (Bertero and Boccacci, Astron. Astrophys. 437, 369, 2005).
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import count
from typing import Literal, NamedTuple

import numpy as np
from scipy import ndimage
from scipy.interpolate import RectBivariateSpline
from scipy.sparse.linalg import LinearOperator, cg

from reconstruction.arrays import Booleans, Counts, Floats, Image
from reconstruction.deconvolution.blur import SpaceVariantBlur, Values
from reconstruction.deconvolution.imaging import Imaging
from reconstruction.frame.noise import CameraNoise, image_transfer
from reconstruction.geometry import Field, Sensor, centered_steps
from reconstruction.quality.image_quality import DIFFRACTION, SAMPLES, aligned, extrapolate, psf_reach_rad
from reconstruction.wavefront import rms

_FEWEST_SAMPLES = 64  # across the pupil


def psf_reach_px(imaging: Imaging, sensor: Sensor, field: Field, phase: Floats) -> int:
    """Half the width that holds nearly all light of wavefronts (..., lenslet_row, lenslet_column), rad."""
    geometry_px = psf_reach_rad(phase, sensor) * field.collimator_focal_length_m / imaging.pixel_m
    return math.ceil(geometry_px + DIFFRACTION * imaging.blur_px(sensor, field))


class PsfOptics:
    """Point-spread functions in the pixels of an image, from wavefronts at the lenslets; prepared once.

    `reach_px` is half their width. `ValueError` if the pupil is larger than the lattice, beyond which no wavefront is
    known.
    """

    def __init__(self, imaging: Imaging, sensor: Sensor, field: Field, reach_px: int) -> None:
        light_m, width_m = imaging.light_m(sensor), imaging.pupil_width_m(sensor, field)
        half_m, is_round = np.array(sensor.pupil_half_width_m), imaging.is_round
        if is_round and width_m > 2 * half_m.min() * (1 + 1e-9):
            raise ValueError(
                f"the imaging pupil of {width_m * 1e3:.4g} mm is wider than the lattice of {half_m.min() * 2e3:.4g} mm,"
                " beyond which no wavefront is known"
            )
        self._sensor, self._scale = sensor, sensor.wavelength_m / light_m
        reach_rad = reach_px * imaging.pixel_m / field.collimator_focal_length_m
        step_m = min(sensor.lenslet_pitch_m / SAMPLES, light_m / (2.1 * reach_rad + 1e-30), width_m / _FEWEST_SAMPLES)
        extent_m = np.full(2, width_m / 2) if is_round else np.abs(imaging.to_field.T) @ half_m
        x_m, y_m = (centered_steps(math.ceil(2 * each / step_m)) for each in extent_m)  # along the axes of the image
        x_m, y_m = x_m * (2 * extent_m[0] / len(x_m)), y_m * (2 * extent_m[1] / len(y_m))
        self._u_m = np.einsum("ij,j...->i...", imaging.to_field, np.stack(np.meshgrid(x_m, y_m)))
        edge_m = width_m / 2 - np.hypot(*self._u_m) if is_round else (half_m[:, None, None] - np.abs(self._u_m))
        share = np.clip(edge_m / step_m + 0.5, 0, 1)  # of a sample at the edge that lies within the pupil
        self._amplitude = share if is_round else share.prod(axis=0)
        pixel_rad = imaging.pixel_m / field.collimator_focal_length_m
        self._parts = math.ceil(2 / imaging.blur_px(sensor, field))  # of a pixel that resolve the pattern
        at_px = np.arange((2 * reach_px + 1) * self._parts) / self._parts - reach_px - (1 - 1 / self._parts) / 2
        turn = -2j * math.pi / light_m * pixel_rad * at_px[:, None]
        self._to_row, self._to_column = np.exp(turn * y_m).astype(np.complex64), np.exp(turn * x_m).astype(np.complex64)

    def __call__(self, phase: Floats) -> Floats:
        """Point-spread function of a wavefront, averaged over each pixel if pixels are coarse.

        A positive slope moves the light towards the field's +x. From rad at the sensor's wavelength, (lenslet_row,
        lenslet_column), NaN where unknown, to (2 reach + 1, 2 reach + 1) in the image's rows and columns; sum 1.
        """
        y_m, x_m = (centered_steps(count + 2) for count in phase.shape)
        y_m, x_m = y_m * self._sensor.row_spacing_m, x_m * self._sensor.lenslet_pitch_m
        spline = RectBivariateSpline(y_m, x_m, extrapolate(aligned(phase, self._sensor.arrangement)))
        fine = spline.ev(self._u_m[1], self._u_m[0]) * self._scale
        field = (self._amplitude * np.exp(1j * np.remainder(fine, 2 * math.pi))).astype(np.complex64)
        light = np.abs(self._to_row @ field @ self._to_column.T).astype(np.float64) ** 2
        side = len(light) // self._parts
        light = light.reshape(side, self._parts, side, self._parts).sum(axis=(1, 3))
        return np.asarray(light / light.sum())


PhaseAt = Callable[[float, float], Floats]
"""Wavefront at a position x, y, m, inside the field: rad, (lenslet_row, lenslet_column); NaN where unknown."""
RestorationMethod = Literal["richardson-lucy", "wiener"]

_UNSEEN = 0.01  # share of a point's light that must reach the image
_TINY = 1e-6  # of the mean light
_GRADIENTS = 8  # conjugate gradients for each strength of the prior
_WEAKER = 0.25  # factor on that strength from one to the next


@dataclass(frozen=True, slots=True, eq=False)
class Restored:
    """An image without blur."""

    image: Values  # light, counts, (row, column)
    iterations: int
    chi_square: float  # reduced, of the image's difference to the blurred result; NaN if the noise is unknown


class _Step(NamedTuple):
    """Estimate of an object, and how well it explains the image."""

    iterations: int  # that led to it
    scene: Values  # light, counts, (row, column)
    misfit: Values  # (light - blurred)^2 over its variance, (row, column); NaN if the noise is unknown


def restored(
    light: Values,
    blur: SpaceVariantBlur,
    method: RestorationMethod,
    *,
    noise: CameraNoise | None,
    counted: Booleans,
    iterations: int,
    progress: Callable[[int, float], None] = lambda *_: None,
) -> Restored:
    """Restore an image (row, column), counts above the dark.

    The chi-square of the `counted` pixels (row, column) ends the iteration; without `noise`, all iterations are done.
    `progress` receives the number of the iteration and the reduced chi-square before it. `ValueError` if the method
    needs the noise.
    """
    steps = (
        _wiener(light, blur, noise, counted, iterations) if method == "wiener" else _richardson_lucy(light, blur, noise)
    )
    for step in steps:
        chi_square = float(np.mean(step.misfit, where=counted, dtype=np.float64))
        progress(step.iterations, chi_square)
        if chi_square <= 1 or step.iterations >= iterations:
            break
    rows, columns = (slice(blur.reach_px, blur.reach_px + length) for length in blur.shape)
    return Restored(step.scene[rows, columns], step.iterations, chi_square)


def _richardson_lucy(light: Values, blur: SpaceVariantBlur, noise: CameraNoise | None) -> Iterator[_Step]:
    """Richardson-Lucy: most probable positive object for shot noise.

    Read noise adds its variance to both sides, which makes shot noise of both (Snyder et al., J. Opt. Soc. Am. A 10,
    1014, 1993).
    """
    light = np.maximum(light, 0)
    extra = 0.0 if noise is None else noise.read_noise_counts**2 / noise.counts_per_light
    tiny = light.dtype.type(_TINY * light.mean() + 1e-30)
    seen = blur.adjoint(np.ones_like(light))
    gain = np.where(seen > _UNSEEN, 1 / np.maximum(seen, _UNSEEN), 0).astype(light.dtype)
    estimate = np.where(seen > _UNSEEN, light.mean(), 0).astype(light.dtype)
    for done in count():
        blurred = np.maximum(blur(estimate), tiny)
        variance = math.nan if noise is None else noise.variance(blurred)
        yield _Step(done, estimate, (light - blurred) ** 2 / variance)
        ratio = (light + light.dtype.type(extra)) / (blurred + light.dtype.type(extra))
        estimate *= np.maximum(blur.adjoint(ratio), 0) * gain


def _wiener(
    light: Values, blur: SpaceVariantBlur, noise: CameraNoise | None, counted: Booleans, iterations: int
) -> Iterator[_Step]:
    """Wiener filter for a space-variant blur.

    It is the most probable object for white noise and a spectrum of 1/frequency^2. The object minimises |light -
    blurred|^2 + strength |gradient|^2 by conjugate gradients, with a strength that is lowered by factors of 4.
    """
    if noise is None:
        raise ValueError(
            "the Wiener filter needs the noise, and these pixels are too coarse to show it: give counts_per_electron"
            " and read_noise_counts"
        )
    variance = float(np.mean(noise.variance(light), where=counted))
    estimate = np.full(blur.object_shape, light.mean(), light.dtype)
    strength, done = 1.0, 0
    while True:
        yield _Step(done, estimate, (light - blur(estimate)) ** 2 / variance)
        steps = min(_GRADIENTS, iterations - done)
        estimate = regularised(light, blur, strength=strength, start=estimate, iterations=steps)
        done, strength = done + steps, strength * _WEAKER


def regularised(light: Values, blur: SpaceVariantBlur, *, strength: float, start: Values, iterations: int) -> Values:
    """Minimise |light - blurred|^2 + strength |gradient|^2 over objects (row, column), by conjugate gradients.

    `light` is an image (row, column), `start` an object; both in any unit.
    """

    def normal(flat: Values) -> Values:
        scene = flat.reshape(start.shape)
        curvature = ndimage.laplace(scene, mode="nearest")  # of the squared gradient, with free edges
        return np.asarray(blur.adjoint(blur(scene)) - light.dtype.type(strength) * curvature).ravel()

    equations = LinearOperator((start.size, start.size), normal, dtype=light.dtype)
    aim, no_residual = blur.adjoint(light).ravel(), float(np.finfo(light.dtype).tiny)
    found, _ = cg(equations, aim, start.ravel(), rtol=0.0, atol=no_residual, maxiter=iterations)
    return np.reshape(found, start.shape)


_PROBES = 5  # along a side of the field, at which reach and change of the wavefront are found
_LEAST_INSIDE_PX = 16  # of the field, along both axes
_RESOLVED_PX = 4.0  # of the optical resolution; finer pixels are binned, 2 px would just sample it
_PREPARATION = 0.15  # share of the work before the first iteration


@dataclass(frozen=True, slots=True, eq=False)
class CorrectedImage:
    """An image without aberration within the measured field."""

    image: Image  # counts, (row, column); as measured outside the field
    inside: Booleans  # pixels within the field
    iterations: int
    chi_square: float  # reduced, of the image's difference to the blurred result; NaN if the noise is unknown


def corrected_image(
    image: Counts,
    phase_at: PhaseAt,
    imaging: Imaging,
    *,
    sensor: Sensor,
    field: Field,
    method: RestorationMethod,
    iterations: int,
    progress: Callable[[str, float], None] = lambda *_: None,
) -> CorrectedImage:
    """Deconvolve an image (row, column), counts, by the point-spread function of each field position.

    Pixels much finer than the optical resolution are binned for the computation. The `iterations` end earlier if only
    noise is left. `progress` receives the step in words and the share that is done. `ValueError` if image, geometry and
    wavefront do not go together; one sentence.
    """
    if not np.isfinite(image).all():
        raise ValueError("the image holds NaN or infinite values: replace them, for example by their neighbours")
    inside = imaging.inside(image.shape, field)
    rows, columns = _span(inside)
    if min(rows[1] - rows[0], columns[1] - columns[0]) < _LEAST_INSIDE_PX:
        raise ValueError(
            f"the measured field covers {rows[1] - rows[0]} x {columns[1] - columns[0]} pixels of the image, and"
            f" {_LEAST_INSIDE_PX} are needed: check pixel_m, center_x_px and center_y_px"
        )
    blur_px = imaging.blur_px(sensor, field)
    if blur_px > max(image.shape):
        raise ValueError(
            f"a point blurs over {blur_px:.3g} pixels, more than the image has: check pixel_m, wavelength_m and"
            " the pupil"
        )
    light = image.astype(np.float32) - np.float32(imaging.dark_counts)
    if not light.max() > 0:
        raise ValueError(f"the image shows no light: no pixel is above dark_counts = {imaging.dark_counts:g}")
    reach, change_rad_per_m = _extent(phase_at, imaging, sensor, field)
    reach = min(reach, max(image.shape))
    part = tuple(slice(max(least - reach, 0), most + reach) for least, most in (rows, columns))
    bins = max(1, int(blur_px / _RESOLVED_PX))
    cut, own = _binned(light[part], bins), _of_part(imaging, image.shape, part, bins)
    counted, reach = own.inside(cut.shape, field), -(-reach // bins)
    known_rows, known_columns = _span(counted)
    optics = PsfOptics(own, sensor, field, reach)

    def psf_at(x_px: float, y_px: float) -> Floats:
        x_m, y_m = own.field_m(np.array(x_px), np.array(y_px), cut.shape)
        return optics(phase_at(*_nearest(float(x_m), float(y_m), field)))

    blur = SpaceVariantBlur(
        psf_at,
        cut.shape,
        reach_px=reach,
        known_px=((known_rows[0], known_rows[1] - 1), (known_columns[0], known_columns[1] - 1)),
        change_rad_per_px=change_rad_per_m * own.pixel_m,
        progress=lambda share: progress("point-spread functions", _PREPARATION * share),
    )

    def iterating(done: int, chi_square: float) -> None:
        misfit = "" if math.isnan(chi_square) else f", chi-square {chi_square:.3g}"
        progress(f"iteration {done}{misfit}", _PREPARATION + (1 - _PREPARATION) * done / iterations)

    if own.counts_per_electron is None:
        curve = image_transfer(cut, own.blur_px(sensor, field))
        noise = None if curve is None else curve.noise
    else:
        noise = CameraNoise(own.counts_per_electron, own.read_noise_counts)
    found = restored(cut, blur, method, noise=noise, counted=counted, iterations=iterations, progress=iterating)
    fine = found.image
    if bins > 1:
        rows, columns = light[part].shape
        fine = ndimage.zoom(fine, bins, order=1, mode="nearest", grid_mode=True)[:rows, :columns]
    light[part] = fine
    result = np.where(inside, light + np.float32(imaging.dark_counts), image.astype(np.float32))
    return CorrectedImage(result, inside, found.iterations, found.chi_square)


def _span(inside: Booleans) -> tuple[tuple[int, int], tuple[int, int]]:
    """Rows and columns (first, after the last) with a pixel `inside` (row, column); zeros if there is none."""
    at = [np.flatnonzero(inside.any(axis=axis)) for axis in (1, 0)]
    rows, columns = ((int(each[0]), int(each[-1]) + 1) if len(each) else (0, 0) for each in at)
    return rows, columns


def _extent(phase_at: PhaseAt, imaging: Imaging, sensor: Sensor, field: Field) -> tuple[int, float]:
    """Reach of the point-spread functions, px, and RMS change of the wavefront, rad per m of the field."""
    at_m = np.linspace(-1, 1, _PROBES) * field.half_width_m
    phase = np.array([[phase_at(*_nearest(float(x), float(y), field)) for x in at_m] for y in at_m])
    if not np.isfinite(phase).any(axis=(-2, -1)).all():
        raise ValueError("the wavefront is unknown in a part of the field: too few lenslets are valid")
    changes = [rms(np.diff(phase, axis=axis)).max() / (at_m[1] - at_m[0]) for axis in (0, 1)]
    return psf_reach_px(imaging, sensor, field, phase), float(max(changes))


def _nearest(x_m: float, y_m: float, field: Field) -> tuple[float, float]:
    """Nearest position of the field to x, y."""
    half_m = field.half_width_m
    if field.shape == "square":
        return min(max(x_m, -half_m), half_m), min(max(y_m, -half_m), half_m)
    scale = half_m / max(math.hypot(x_m, y_m), half_m)
    return x_m * scale, y_m * scale


def _binned(image: Image, bins: int) -> Image:
    """Mean of an image (row, column) over squares of pixels; the last ones repeat the edge."""
    padded = np.pad(image, [(0, -length % bins) for length in image.shape], mode="edge")
    rows, columns = (length // bins for length in padded.shape)
    return np.asarray(padded.reshape(rows, bins, columns, bins).mean(axis=(1, 3)), np.float32)


def _of_part(imaging: Imaging, shape: tuple[int, ...], part: tuple[slice, ...], bins: int) -> Imaging:
    """Geometry and noise of a binned part of an image."""
    corner = np.array([part[1].start, part[0].start]) + (bins - 1) / 2
    x_px, y_px = (imaging.center_px(shape) - corner) / bins
    return replace(
        imaging,
        pixel_m=imaging.pixel_m * bins,
        center_x_px=float(x_px),
        center_y_px=float(y_px),
        counts_per_electron=None if imaging.counts_per_electron is None else imaging.counts_per_electron / bins**2,
        read_noise_counts=imaging.read_noise_counts / bins,
    )
