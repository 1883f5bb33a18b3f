"""Layers of a measurement and what a corrector could do, for the window."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
import xarray as xr

from app.measurement.calibration import Calibration
from app.measurement.measurement import Measurement
from app.memory import kept_for_bench
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


@dataclass(frozen=True, slots=True, eq=False)
class FoundLayers:
    """Layers found in a measurement, or the problem."""

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


def find_shown_layers(
    measurement: Measurement, origin: Origin, *, count: int, ratio: float, check: Callable[[], None]
) -> FoundLayers:
    """Search for `count` layers, or fit one at a known `ratio` of field to pupil position if `count` is 0.

    Distances are measured from the `origin`, if possible. An exception of `check` ends the search.
    """
    calibration, wavefront = measurement.calibration, measurement.wavefront
    if calibration is None or wavefront is None:
        return FoundLayers(_NO_WAVEFRONT)
    try:
        layers = _reconstructor(calibration).layers(wavefront.displacement)
        if not count:
            return _shown(layers.fit(ratio), origin, calibration)
        search = find_layers(layers, count, check=check)
    except ReconstructionError as error:
        return FoundLayers(str(error))
    found = _shown(search.fit, origin, calibration)
    return replace(found, search=search, curve_m=distance_m(search.ratios, found.origin, calibration.bench))


def _shown(fit: LayerFit, wanted: Origin, calibration: Calibration) -> FoundLayers:
    ratios = tuple(layer.ratio for layer in fit.layers)
    origin = possible_origin(wanted, ratios)
    distances_m, sigma_m = distances_and_sigma_m(fit.layers, origin, calibration.bench)
    x_m, y_m, maps = layer_maps(fit.layers, origin, Layer.phase, _MAP_POINTS)
    phases, limits_rad = zip(*map(centred, maps), strict=True)
    return FoundLayers(
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


@dataclass(frozen=True, slots=True, eq=False)
class FoundCorrectors:
    """Correctors at every distance, see `correction_dataset`, or the problem."""

    problem: str = ""
    found: xr.Dataset | None = None


def find_shown_correctors(measurement: Measurement, origin: Origin, corrector: Corrector) -> FoundCorrectors:
    """Compare correctors at every distance."""
    calibration, wavefront = measurement.calibration, measurement.wavefront
    if calibration is None or wavefront is None:
        return FoundCorrectors(_NO_WAVEFRONT)
    try:
        made = compare_correctors(wavefront.at, wavefront.sensor, wavefront.field, corrector)
    except ValueError as error:
        return FoundCorrectors(str(error))
    return FoundCorrectors(found=correction_dataset(made, calibration.bench, origin))
