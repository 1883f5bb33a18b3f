"""Analysis of a wavefront for display: maps of a chosen quantity, MTF, isoplanatism, coefficients, one lenslet."""

import math
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import lru_cache
from typing import ClassVar, Self

from app.measurement.measurement import Measurement
from app.results.lenslet_inspection import LensletInspection, inspect_lenslet
from app.results.mode_coefficients import ModeChoice, ModeCoefficients, mode_coefficients
from reconstruction.arrays import Floats
from reconstruction.geometry import Sensor
from reconstruction.modes.pupil_modes import PupilModes, pupil_modes
from reconstruction.quality.image_quality import Mtf, mtf, psf, psf_angles_rad, psf_reach_rad
from reconstruction.quality.isoplanatism import Isoplanatism, isoplanatism
from reconstruction.quality.slope_fit import slope_fit
from reconstruction.settings import PupilBasis, ReconstructionSettings
from reconstruction.wavefront import Wavefront


class Quantity(StrEnum):
    """Quantity that is mapped for every view."""

    WAVEFRONT = "Wavefront"
    PSF = "PSF"
    MEASURED = "Measured"
    FITTED = "Fitted"
    DIFFERENCE = "Difference"
    UNCERTAINTY = "Uncertainty"


@dataclass(frozen=True, slots=True)
class AnalysisRequest:
    """A wavefront and what to compute from it."""

    wavefront: Wavefront
    settings: ReconstructionSettings
    quantity: Quantity
    reach_rad: float | None  # half width of PSF maps; None: as far as there is light
    view: tuple[int, int] | None  # view whose MTF is computed; None: neither MTF nor isoplanatism
    modes: ModeChoice | None = None  # coefficients to compute
    lenslet: tuple[int, int] | None = None  # lenslet to inspect
    measurement: Measurement | None = None  # of the wavefront; the inspection needs it

    interval_s: ClassVar[float] = 0.2  # between two analyses of a running measurement

    def follows(self, other: Self) -> bool:
        """Return whether only wavefront and measurement differ."""
        return replace(self, wavefront=other.wavefront, measurement=other.measurement) == other


@dataclass(frozen=True, slots=True, eq=False)
class Analysis:
    """The results; None if not requested."""

    request: AnalysisRequest
    maps: Floats | None = None  # rad or a ratio, (view_row, view_column, row, column)
    reach_rad: float = math.nan  # from the middle of a PSF map to the middle of its last pixel
    light_reach_rad: float = math.nan  # how far there is light
    transfer: Mtf | None = None
    isoplanatism: Isoplanatism | None = None
    coefficients: ModeCoefficients | None = None
    inspection: LensletInspection | None = None


def analyse(request: AnalysisRequest) -> Analysis:
    """Compute what is requested; the maps of the wavefront itself are its `views`."""
    analysis, wavefront = _maps(request), request.wavefront
    if request.modes is not None:
        analysis = replace(analysis, coefficients=mode_coefficients(wavefront, request.modes))
    if request.lenslet is not None and request.measurement is not None:
        analysis = replace(analysis, inspection=inspect_lenslet(request.measurement, *request.lenslet))
    if request.view is None:
        return analysis
    return replace(
        analysis, transfer=mtf(wavefront.views[request.view], wavefront.sensor), isoplanatism=isoplanatism(wavefront)
    )


def _maps(request: AnalysisRequest) -> Analysis:
    wavefront, settings, quantity = request.wavefront, request.settings, request.quantity
    if quantity is Quantity.PSF:
        return _psf_maps(request)
    if quantity is Quantity.UNCERTAINTY:
        return Analysis(request, wavefront.sigma())
    if quantity is Quantity.WAVEFRONT:
        return Analysis(request)
    coefficients = wavefront.coefficients
    count = settings.pupil_modes if coefficients is None else len(coefficients)
    fit = slope_fit(wavefront, wavefront.sensor, _modes(wavefront.sensor, settings.basis, count))
    maps = {Quantity.MEASURED: fit.measured, Quantity.FITTED: fit.fitted, Quantity.DIFFERENCE: fit.difference}
    return Analysis(request, maps[quantity])


def _psf_maps(request: AnalysisRequest) -> Analysis:
    views, sensor = request.wavefront.views, request.wavefront.sensor
    light_reach_rad = psf_reach_rad(views, sensor)
    reach_rad = light_reach_rad if request.reach_rad is None else request.reach_rad
    if not math.isfinite(reach_rad):
        return Analysis(request)
    maps = psf(views, sensor, angle_rad=psf_angles_rad(sensor, reach_rad))
    return Analysis(request, maps, reach_rad, light_reach_rad)


@lru_cache(maxsize=2)
def _modes(sensor: Sensor, basis: PupilBasis, count: int | None) -> PupilModes:
    return pupil_modes(sensor, basis, count)
