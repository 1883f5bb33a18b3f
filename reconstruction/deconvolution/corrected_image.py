"""An image without the measured aberration: deconvolved within the field, untouched beyond it."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy import ndimage

from reconstruction.arrays import Counts, Floats, Image, Mask
from reconstruction.deconvolution.blur import SpaceVariantBlur
from reconstruction.deconvolution.imaging import Imaging
from reconstruction.deconvolution.psf_optics import PsfOptics, reach_px
from reconstruction.deconvolution.restoration import richardson_lucy, wiener
from reconstruction.frame.noise import CameraNoise, image_transfer
from reconstruction.geometry import Field, Sensor
from reconstruction.wavefront import rms

PhaseAt = Callable[[float, float], Floats]
"""Wavefront at a position x, y, m, inside the field: rad, (lenslet_row, lenslet_column); NaN where unknown."""
RestorationMethod = Literal["richardson-lucy", "wiener"]

_PROBES = 5  # along a side of the field, at which reach and change of the wavefront are found
_LEAST_INSIDE_PX = 16  # of the field, along both axes
_RESOLVED_PX = 4.0  # of the optical resolution; finer pixels are binned, 2 px would just sample it
_PREPARATION = 0.15  # share of the work before the first iteration


@dataclass(frozen=True, slots=True, eq=False)
class CorrectedImage:
    """An image without aberration within the measured field."""

    image: Image  # counts, (row, column); as measured outside the field
    inside: Mask  # pixels within the field
    iterations: int
    chi_square: float  # reduced, of the image's difference to the blurred result; NaN if the noise is unknown


def corrected_image(
    image: Counts,
    phase_at: PhaseAt,
    imaging: Imaging,
    *,
    sensor: Sensor,
    field: Field,
    method: RestorationMethod = "richardson-lucy",
    iterations: int = 50,
    progress: Callable[[str, float], None] = lambda *_: None,
) -> CorrectedImage:
    """Deconvolve an image by the point-spread function of each field position.

    Pixels much finer than the optical resolution are binned for the computation.

    Parameters
    ----------
    image : (row, column)
        Counts.
    phase_at : callable
        Wavefront at a field position.
    imaging, sensor, field
        Geometry of the image and of the bench.
    method : str
        Richardson-Lucy or Wiener.
    iterations : int
        At most; fewer if only noise is left.
    progress : callable, optional
        Receives the step in words and the share that is done.

    Raises
    ------
    ValueError
        If image, geometry and wavefront do not go together; one sentence.
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
    light = image.astype(np.float32) - np.float32(imaging.dark_counts)
    reach, change_rad_per_m = _extent(phase_at, imaging, sensor, field)
    reach = min(reach, max(image.shape))
    part = tuple(slice(max(least - reach, 0), most + reach) for least, most in (rows, columns))
    bins = max(1, int(imaging.blur_px(sensor, field) / _RESOLVED_PX))
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

    restore = wiener if method == "wiener" else richardson_lucy
    if own.counts_per_electron is None:
        curve = image_transfer(cut, own.blur_px(sensor, field))
        noise = None if curve is None else curve.noise
    else:
        noise = CameraNoise(own.counts_per_electron, own.read_noise_counts)
    restored = restore(cut, blur, noise=noise, counted=counted, iterations=iterations, progress=iterating)
    fine = restored.image
    if bins > 1:
        fine = ndimage.zoom(fine, bins, order=1, mode="nearest", grid_mode=True)[
            : light[part].shape[0], : light[part].shape[1]
        ]
    light[part] = fine
    result = np.where(inside, light + np.float32(imaging.dark_counts), image.astype(np.float32))
    return CorrectedImage(result, inside, restored.iterations, restored.chi_square)


def _span(inside: Mask) -> tuple[tuple[int, int], tuple[int, int]]:
    """First row and column with a pixel inside, and the first after the last one; zeros if there is none."""
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
    return reach_px(imaging, sensor, field, phase), float(max(changes))


def _nearest(x_m: float, y_m: float, field: Field) -> tuple[float, float]:
    """Nearest position of the field to x, y."""
    half_m = field.half_width_m
    if field.shape == "square":
        return min(max(x_m, -half_m), half_m), min(max(y_m, -half_m), half_m)
    scale = half_m / max(math.hypot(x_m, y_m), half_m)
    return x_m * scale, y_m * scale


def _binned(image: Image, bins: int) -> Image:
    """Mean over squares of pixels; the last ones repeat the edge."""
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
