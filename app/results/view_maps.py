"""Analysis of a wavefront for display: maps of its quantities, and everything known of one lenslet."""

import math
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import lru_cache

import numpy as np

from app.cache import kept_while_alive
from app.measurement.calibration import Calibration
from app.measurement.measurement import Measurement
from app.results.run_summary import noise_above_rms, rms_over_lenslets
from reconstruction.arrays import Floats, Image
from reconstruction.displacement import Displacement, LensletStatus, field_means
from reconstruction.errors import ReconstructionError
from reconstruction.frame.bad_pixels import find_bad_pixels
from reconstruction.frame.pixels import DarkSubtractor
from reconstruction.frame.spline import interpolate
from reconstruction.modes.pupil_modes import pupil_modes
from reconstruction.quality.image_quality import psf, psf_angles_rad, psf_reach_rad
from reconstruction.quality.slope_residual import slope_residual
from reconstruction.registration.subimages import ReferenceSubimages
from reconstruction.settings import ReconstructionSettings
from reconstruction.wavefront import Wavefront, mean_known, mean_rms, peak_to_valley, rms


@dataclass(frozen=True, slots=True, eq=False)
class LensletInspection:
    """One lenslet of one frame; images are light, counts, (row, column), along the lattice."""

    outcome: LensletStatus
    reference: Floats
    frame: Floats
    fitted: Floats | None  # the frame warped back onto the reference, with its gain and offset; None if lost
    residual: Floats | None  # reference minus fitted; NaN outside the image of the field
    displacement_px: Floats  # mean over the field, (xy,); NaN if lost
    sigma_px: Floats  # its standard deviation, (xy,)
    residual_rms: float  # over the contrast of the reference's best subimage
    chi_square: float
    range_used: float


def inspect_lenslet(measurement: Measurement, row: int, column: int) -> LensletInspection | None:
    """Inspect a lenslet; None without a reconstruction, or if the lenslet is not on the lattice."""
    calibration, wavefront = measurement.calibration, measurement.wavefront
    if calibration is None or wavefront is None:
        return None
    displacement = measurement.registered or wavefront.displacement
    rows, columns = displacement.outcome.shape
    if not (row < rows and column < columns):
        return None
    try:
        dark_subtractor, subimages = _prepared(calibration)
        light, saturated = dark_subtractor(measurement.frame.pixels, "frame")
    except ReconstructionError:
        return None
    coefficients = subimages.spline(light, saturated=saturated)
    index, square = row * columns + column, (subimages.width, subimages.width)
    reference = subimages.light[index].astype(np.float64)
    frame, _ = interpolate(coefficients, subimages.position_px[index])
    fitted = residual = None
    if displacement.valid[row, column]:
        is_fitted = (np.abs(subimages.offset_px) <= subimages.half_width_px + subimages.blur_px).all(axis=1)
        warped, stretch = _warped(subimages, coefficients, displacement, calibration, index)
        terms = np.stack([warped * stretch, stretch], axis=1)
        gain_and_offset = np.linalg.lstsq(terms[is_fitted], reference[is_fitted])[0]
        fitted = (terms @ gain_and_offset).reshape(square)
        residual = np.where(is_fitted, reference - fitted.ravel(), np.nan).reshape(square)
    share = field_means(displacement.modes)
    variance = np.einsum("q,qdrd,r->d", share, displacement.covariance[row, column], share)
    return LensletInspection(
        LensletStatus(int(displacement.outcome[row, column])),
        reference.reshape(square),
        np.asarray(frame, np.float64).reshape(square),
        fitted,
        residual,
        displacement.mean[row, column],
        np.asarray(np.sqrt(variance)),
        *(float(getattr(displacement, name)[row, column]) for name in ("residual_rms", "chi_square", "range_used")),
    )


@kept_while_alive(maxsize=1)
def _prepared(calibration: Calibration) -> tuple[DarkSubtractor, ReferenceSubimages]:
    """Light as the registration sees it, and its subimages of the reference."""
    reference = calibration.reference.mean
    dark_subtractor = DarkSubtractor(reference.shape, calibration.camera)
    light, _ = dark_subtractor(reference, "reference")
    subimages = ReferenceSubimages(
        light,
        sensor=calibration.bench.sensor,
        lattice=calibration.lattice,
        field=calibration.bench.field,
        bad=find_bad_pixels(reference, calibration.dark_image, blur_px=calibration.bench.sensor.blur_px),
    )
    return dark_subtractor, subimages


def _warped(
    subimages: ReferenceSubimages, coefficients: Image, displacement: Displacement, calibration: Calibration, index: int
) -> tuple[Floats, Floats]:
    """Light of the frame where the fitted warp takes window positions, and the stretch there, (N,)."""
    modes, offset_px = displacement.modes, subimages.offset_px
    x, y = offset_px.T / subimages.half_width_px
    by_mode = displacement.coefficients.reshape(-1, modes.count, 2)[index]
    moved_px = offset_px + modes.values(x, y).T @ by_mode
    position_px = subimages.center_px[index] + moved_px @ subimages.turn
    edge = np.array(coefficients.shape[::-1]) - 1
    values, _ = interpolate(coefficients, np.clip(position_px, 0, edge))
    gradients = getattr(modes, "gradients", None)  # interpolation between stars has none
    if gradients is None or not calibration.bench.field.neglect_propagation:
        return np.asarray(values, np.float64), np.ones(len(values))
    jacobian = np.eye(2) + np.einsum("qnk,qd->ndk", gradients(x, y), by_mode) / subimages.half_width_px
    return np.asarray(values, np.float64), np.linalg.det(jacobian)


class Quantity(StrEnum):
    """Quantity that is mapped for every view."""

    WAVEFRONT = "Wavefront"
    PSF = "PSF"
    RESIDUAL = "Residual"
    UNCERTAINTY = "Uncertainty"


@dataclass(frozen=True, slots=True, eq=False)
class ViewNumbers:
    """Two numbers of each view, (view_row, view_column), and one of all: rad, or ratios of a PSF."""

    quantity: Quantity
    first: Floats  # RMS, Strehl ratio, or mean of the standard deviations
    second: Floats  # peak to valley, peak, or maximum
    mean: float  # of the RMS, or of all standard deviations; NaN for a PSF
    noise_rad: float | None = None  # that hides the wavefront of a single frame
    sigma_rad: Floats | None = None  # errors of the maps of a single frame
    error_rad: Floats | None = None  # their RMS over the lenslets


def view_numbers(quantity: Quantity, maps: Floats, single: Wavefront | None = None) -> ViewNumbers:
    """Return the numbers of maps (view_row, view_column, row, column), with a `single` frame's errors."""
    if quantity is Quantity.PSF:
        middle = maps[..., maps.shape[2] // 2, maps.shape[3] // 2]
        return ViewNumbers(quantity, middle, maps.max(axis=(2, 3)), math.nan)
    if quantity is Quantity.UNCERTAINTY:
        most = np.max(maps, axis=(2, 3), initial=-np.inf, where=np.isfinite(maps))
        return ViewNumbers(quantity, mean_known(maps), most, float(mean_known(maps, axis=None)))
    found = ViewNumbers(quantity, rms(maps), peak_to_valley(maps), mean_rms(maps))
    if single is None:
        return found
    sigma_rad = single.sigma()
    noise_rad, error_rad = noise_above_rms(single), rms_over_lenslets(sigma_rad)
    return replace(found, noise_rad=noise_rad, sigma_rad=sigma_rad, error_rad=error_rad)


@dataclass(frozen=True, slots=True, eq=False)
class QuantityMaps:
    """Maps of a quantity for every view."""

    values: Floats  # rad or a ratio, (view_row, view_column, row, column)
    reach_rad: float = math.nan  # from the middle of a PSF map to the middle of its last pixel
    light_reach_rad: float = math.nan  # how far there is light
    numbers: ViewNumbers | None = None  # None: not yet computed


def quantity_maps(
    wavefront: Wavefront, quantity: Quantity, settings: ReconstructionSettings, reach_rad: float | None = None
) -> QuantityMaps | None:
    """Compute maps with numbers, a PSF up to `reach_rad` or the light's; None for a PSF without any light."""
    found = _maps(wavefront, quantity, settings, reach_rad)
    return None if found is None else replace(found, numbers=view_numbers(quantity, found.values))


def _maps(
    wavefront: Wavefront, quantity: Quantity, settings: ReconstructionSettings, reach_rad: float | None
) -> QuantityMaps | None:
    if quantity is Quantity.WAVEFRONT:
        return QuantityMaps(wavefront.views)
    if quantity is Quantity.UNCERTAINTY:
        return QuantityMaps(wavefront.sigma())
    if quantity is Quantity.PSF:
        sensor = wavefront.sensor
        light_reach_rad = psf_reach_rad(wavefront.views, sensor)
        reach_rad = light_reach_rad if reach_rad is None else reach_rad
        if not math.isfinite(reach_rad):
            return None
        maps = psf(wavefront.views, sensor, angle_rad=psf_angles_rad(sensor, reach_rad))
        return QuantityMaps(maps, reach_rad, light_reach_rad)
    coefficients = wavefront.coefficients
    count = settings.pupil_modes if coefficients is None else len(coefficients)
    return QuantityMaps(slope_residual(wavefront, _modes(wavefront.sensor, settings.basis, count)))


_modes = lru_cache(maxsize=2)(pupil_modes)
