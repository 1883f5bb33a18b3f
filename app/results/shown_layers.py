"""Layers of a measurement and what a corrector could do, for the window."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Self

import numpy as np
import xarray as xr

from app.cache import kept_for_bench
from app.measurement.calibration import Calibration
from app.measurement.measurement import Measurement
from app.results.corrector import compare_correctors, correction_dataset
from app.results.layers import Origin, centred, distance_m, distances_and_sigma_m, layer_maps, possible_origin
from reconstruction.arrays import Floats
from reconstruction.errors import ReconstructionError
from reconstruction.layers.corrector import Corrector
from reconstruction.layers.layer_fit import Layer, LayerFit
from reconstruction.layers.layer_search import LayerSearch, find_layers
from reconstruction.pipeline import Reconstructor

_MAP_POINTS = 65  # along each side
_NO_WAVEFRONT = "there is no wavefront"
_none = partial(np.zeros, 0)


@dataclass(frozen=True, slots=True)
class _Request:
    """A measurement and what to answer about it."""

    measurement: Measurement
    origin: Origin  # of distances
    interval_s: float

    def follows(self, other: Self) -> bool:
        """Return whether only the measurement differs."""
        return replace(self, measurement=other.measurement) == other


@dataclass(frozen=True, slots=True)
class LayersRequest(_Request):
    """Asks which layers are in a measurement."""

    count: int  # of layers to search for; 0 for one that is known
    ratio: float | None  # of field to pupil position at the known layer


@dataclass(frozen=True, slots=True, eq=False)
class FoundLayers:
    """Layers found in a measurement, or the problem."""

    request: LayersRequest
    problem: str = ""  # why there are none
    origin: Origin = "lenslets"  # of the distances, see `possible_origin`
    ratios: tuple[float, ...] = ()  # of the layers
    distances_m: Floats = field(default_factory=_none)  # (layer,)
    sigma_m: Floats = field(default_factory=_none)  # (layer,); NaN for a known distance
    half_width_m: tuple[float, float] = (0.0, 0.0)  # of the maps, x and y
    maps: Floats = field(default_factory=_none)  # phase, rad, (layer, y, x), see `centred`; NaN where no ray meets it
    limit_rad: float = 0.0  # that nearly all values lie within
    misfit: float = math.nan  # unexplained share of the displacements
    search: LayerSearch | None = None
    curve_m: Floats = field(default_factory=_none)  # distances tried; NaN where `origin` has none


def find_shown_layers(request: LayersRequest, check: Callable[[], None]) -> FoundLayers:
    """Search for layers, or fit one at the known distance; an exception of `check` ends the search."""
    calibration, wavefront = request.measurement.calibration, request.measurement.wavefront
    if calibration is None or wavefront is None:
        return FoundLayers(request, _NO_WAVEFRONT)
    try:
        reconstructor = _reconstructor(calibration)
        if request.ratio is not None:
            return _shown(request, calibration, reconstructor.layers(wavefront.displacement).fit(request.ratio))
        search = find_layers(reconstructor.layers(wavefront.displacement), request.count, check=check)
    except ReconstructionError as error:
        return FoundLayers(request, str(error))
    found = _shown(request, calibration, search.fit)
    return replace(found, search=search, curve_m=distance_m(search.ratios, found.origin, calibration.bench))


def _shown(request: LayersRequest, calibration: Calibration, fit: LayerFit) -> FoundLayers:
    ratios = tuple(layer.ratio for layer in fit.layers)
    origin = possible_origin(request.origin, ratios)
    distances_m, sigma_m = distances_and_sigma_m(fit.layers, origin, calibration.bench)
    x_m, y_m, maps = layer_maps(fit.layers, origin, Layer.phase, _MAP_POINTS)
    phases, limits_rad = zip(*map(centred, maps), strict=True)
    return FoundLayers(
        request,
        origin=origin,
        ratios=ratios,
        distances_m=distances_m,
        sigma_m=sigma_m,
        half_width_m=(float(x_m[-1]), float(y_m[-1])),
        maps=np.array(phases),
        limit_rad=max(limits_rad),
        misfit=fit.quality.misfit,
    )


@kept_for_bench(maxsize=1)
def _reconstructor(calibration: Calibration) -> Reconstructor:
    """Another reconstructor than that of the acquisition, because measurements do not carry it."""
    return calibration.reconstructor()


@dataclass(frozen=True, slots=True)
class CorrectorRequest(_Request):
    """Asks what a corrector would leave of a measurement."""

    corrector: Corrector


@dataclass(frozen=True, slots=True, eq=False)
class FoundCorrectors:
    """Correctors at every distance, see `correction_dataset`, or the problem."""

    request: CorrectorRequest
    problem: str = ""
    found: xr.Dataset | None = None


def find_shown_correctors(request: CorrectorRequest) -> FoundCorrectors:
    """Compare correctors at every distance."""
    calibration, wavefront = request.measurement.calibration, request.measurement.wavefront
    if calibration is None or wavefront is None:
        return FoundCorrectors(request, _NO_WAVEFRONT)
    try:
        made = compare_correctors(wavefront.at, wavefront.sensor, wavefront.field, request.corrector)
    except ValueError as error:
        return FoundCorrectors(request, str(error))
    return FoundCorrectors(request, found=correction_dataset(made, calibration.bench, request.origin))
