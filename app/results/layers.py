"""Layers of the sample (docs/layers.md): at which distances they are, and their phase."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from app.bench.config import Bench
from app.errors import InputError
from app.progress import Progress
from app.results.result_file import about
from app.results.sources import measured, measured_frame
from reconstruction.arrays import Floats
from reconstruction.errors import ReconstructionError
from reconstruction.layers.layer_search import FARTHEST_RATIO, LayerSearch, search_layers
from reconstruction.layers.layer_solver import Layer

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes

    from app.measurement.measurement import Measurement
    from app.measurement.offline_reconstructor import OfflineReconstructor
    from app.plotting import Figure
    from reconstruction.wavefront import Wavefront

Origin = Literal["lenslets", "mask"]  # where distances are measured from
COUNT = 1  # of layers to look for, unless another is chosen


def find_layers(
    reconstructor: OfflineReconstructor,
    wavefront: Wavefront,
    count: int = COUNT,
    *,
    distances_m: tuple[float, ...] = (),
) -> xr.Dataset:
    """Find at which distance from the lenslets the aberration originates (docs/layers.md).

    Parameters
    ----------
    reconstructor
        Result of `svwfs.reconstructor`.
    wavefront
        A wavefront made by it.
    count
        Number of layers to look for, 1 or 2.
    distances_m
        Known distances of the layers, negative behind the lenslets; found if omitted.

    Returns
    -------
    xarray.Dataset
        `distance_m(layer)` and `layer_phase(layer, y, x)` with their errors, `chi_square(distance)` and `misfit` of a
        single layer, `model_misfit(model)`; the attribute `verdict` says how many layers explain the wavefront, and
        `doubt` why that may be wrong.

    Raises
    ------
    ReconstructionError
        If too few lenslets are valid, or the displacements do not change over the field.

    Examples
    --------
    >>> layers = svwfs.find_layers(reconstruct, reconstruct(images.frames[0]))
    >>> layers.attrs["verdict"]
    'one layer'
    >>> bool(abs(layers["distance_m"].item() - 0.195) < 0.005)  # as the bench says
    True
    """
    wavefront = measured(wavefront)
    ratios = tuple(ratio_at(distance_m, "lenslets", reconstructor.bench) for distance_m in distances_m)
    found = search_layers(reconstructor.layers(wavefront), count, at=ratios)
    return layers_dataset(found, reconstructor.bench, "lenslets")


def layers_of_frame(
    source: Path,
    frame: int,
    *,
    count: int = COUNT,
    distances_m: Iterable[float] = (),
    origin: Origin = "lenslets",
    progress: Progress = lambda *_: None,
) -> tuple[Bench, xr.Dataset]:
    """Find layers in a frame, from 0, of a recording or results, measured from the `origin`; return bench, too."""
    progress("reconstructing the frame", 0.0)
    bench, equations = measured_frame(source, frame)
    ratios = tuple(ratio_at(distance_m, origin, bench) for distance_m in distances_m)
    progress("finding the layers", 0.3)
    return bench, layers_dataset(search_layers(equations, count, at=ratios), bench, origin)


def layer_sentences(found: xr.Dataset) -> list[str]:
    """Say the distances, and what explains the displacements."""
    origin = found.attrs["distances_from"]
    at = zip(found["distance_m"].values, found["distance_sigma_m"].values, strict=True)
    lines = ["layer " + distance_in_words(*each, origin).replace("\N{PLUS-MINUS SIGN}", "+-") for each in at]
    if found.attrs["verdict"].startswith("nothing"):
        lines = []
    shares = [float(f"{100 * misfit:.2g}") for misfit in found["model_misfit"].values]
    chi_squares = found["model_chi_square"].values
    for name, share, chi_square in zip(found["model"].values, shares, chi_squares, strict=True):
        reduced = "below 0.01" if chi_square < 0.005 else f"{chi_square:.2f}"
        is_smoothed = name == "any wavefront" and share > min(shares)
        smoothed = "; layers leave less, because this fit is smoothed" * is_smoothed
        unexplained = f"{share:g} % of the displacements unexplained"
        lines.append(f"{name}: {unexplained}, reduced chi-square {reduced}{smoothed}")
    return [*lines, "; but ".join(filter(None, (f"verdict: {found.attrs['verdict']}", found.attrs["doubt"])))]


MAP_POINTS = 129  # of a phase map along its longer axis
_FARTHEST, _LEAST_SHOWN_M = 2.0, 0.3  # end of a distance axis, over the farthest distance found, and at least
_OTHER_SIDE = 0.5  # of it, shown on the other side of the lenslets
_FROM: dict[Origin, str] = {"lenslets": "in front of the lenslets", "mask": "from the mask"}
_FINE_M = 1e-4  # errors below it have two decimals in mm
_AMBIGUOUS = {
    1: "none: one layer has its tilt and all other terms",
    2: "tilt: the maps have none, because the tilts of two layers cannot be separated; quadratic terms are uncertain,"
    " as layer_phase_sigma says",
}


def ratio_at(distance_m: float, origin: Origin, bench: Bench) -> float:
    """Ratio r of field to pupil position at which rays meet a layer; `InputError` outside the geometry.

    Distances d are positive towards the source: r = -d / f1 from the lenslets, r = 1 - f1 / d from the mask.
    """
    nearest_m, farthest_m = distance_range_m(origin, bench)
    if not nearest_m <= distance_m <= farthest_m:
        raise InputError(
            f"a distance of {distance_m:g} m lies outside the search range, {nearest_m:.3g} ... {farthest_m:.3g} m"
            f" from the {origin}"
        )
    focal_length_m = bench.field.collimator_focal_length_m
    return -distance_m / focal_length_m if origin == "lenslets" else 1 - focal_length_m / distance_m


def distance_m(ratio: Floats | float, origin: Origin, bench: Bench) -> Floats:
    """Distance of layers with those ratios (...), m; from the mask, NaN behind the lenslets."""
    focal_length_m, ratio = bench.field.collimator_focal_length_m, np.asarray(ratio, np.float64)
    if origin == "lenslets":
        return np.asarray(-focal_length_m * ratio)
    return np.asarray(np.where(ratio <= 0, focal_length_m / (1 + np.abs(ratio)), np.nan))


def tried_distances_m(ratios: Floats, origin: Origin, bench: Bench) -> tuple[Floats, NDArray[np.intp]]:
    """Rising distances of the ratios (candidate,) that have one, m, and the indices of these."""
    distances_m = distance_m(ratios, origin, bench)
    order = np.argsort(distances_m)[: np.count_nonzero(np.isfinite(distances_m))]  # NaN comes last
    return distances_m[order], order


def possible_origin(origin: Origin, ratios: Iterable[float]) -> Origin:
    """Return `origin`, but the lenslets if a layer lies behind them: the mask has no distance there."""
    return "lenslets" if any(ratio > 0 for ratio in ratios) else origin


def distance_range_m(origin: Origin, bench: Bench) -> tuple[float, float]:
    """Shortest and longest distance at which layers are searched for, m."""
    nearest = FARTHEST_RATIO if origin == "lenslets" else 0.0
    ends = distance_m(np.array([nearest, -FARTHEST_RATIO]), origin, bench)
    return float(ends.min()), float(ends.max())


def shown_range_m(found_m: Floats, tried_m: Floats, origin: Origin) -> tuple[float, float]:
    """Ends of a distance axis: from the mask all that was tried (candidate,), else around those found (layer,)."""
    tried_m = tried_m[np.isfinite(tried_m)]
    if origin == "mask":
        return 0.0, float(tried_m.max())
    reach_m = max(_LEAST_SHOWN_M, _FARTHEST * float(np.max(np.abs(found_m))))
    low_m = -reach_m * (1.0 if np.min(found_m) < 0 else _OTHER_SIDE)
    high_m = reach_m * (1.0 if np.max(found_m) >= 0 else _OTHER_SIDE)
    return max(low_m, float(tried_m.min())), min(high_m, float(tried_m.max()))


def distance_in_words(at_m: float, sigma_m: float, origin: Origin) -> str:
    """Distance in mm with its error, if that is known: "195.0 ± 1.2 mm in front of the lenslets"."""
    where = "behind the lenslets" if origin == "lenslets" and at_m < 0 else _FROM[origin]
    if not math.isfinite(sigma_m):
        return f"{abs(at_m) * 1e3:.1f} mm {where}"
    decimals = 1 if sigma_m > _FINE_M else 2
    return f"{abs(at_m) * 1e3:.{decimals}f} \N{PLUS-MINUS SIGN} {sigma_m * 1e3:.{decimals}f} mm {where}"


def layer_maps(
    layers: tuple[Layer, ...],
    origin: Origin,
    values: Callable[[Layer, Floats, Floats], Floats],
    points: int = MAP_POINTS,
) -> tuple[Floats, Floats, Floats]:
    """Positions x and y, m, and values (layer, y, x), `Layer.phase` or `Layer.sigma`; narrower near the mask."""
    scales = [1 / (1 - layer.ratio) if origin == "mask" else 1.0 for layer in layers]
    reach_m = np.max([layer.half_width_m * scale for layer, scale in zip(layers, scales, strict=True)], axis=0)
    x_m, y_m = (np.linspace(-most, most, points) for most in reach_m)
    maps = [values(layer, x_m / scale, y_m[:, None] / scale) for layer, scale in zip(layers, scales, strict=True)]
    return x_m, y_m, np.array(maps)


def centred(phase: Floats) -> tuple[Floats, float]:
    """Phase (y, x) about the middle of its range, and half the range, but for one percent at either end."""
    low, high = np.nanpercentile(phase, (1, 99))
    return phase - (low + high) / 2, float(high - low) / 2


def distances_and_sigma_m(layers: tuple[Layer, ...], origin: Origin, bench: Bench) -> tuple[Floats, Floats]:
    """Distances of the layers and their standard deviations, m; NaN for given distances."""
    ratio, ratio_sigma = (np.array([getattr(layer, name) for layer in layers]) for name in ("ratio", "ratio_sigma"))
    per_ratio_m = bench.field.collimator_focal_length_m * (1 - ratio) ** (-2.0 if origin == "mask" else 0.0)
    return distance_m(ratio, origin, bench), per_ratio_m * ratio_sigma


def layers_dataset(found: LayerSearch, bench: Bench, origin: Origin, points: int = MAP_POINTS) -> xr.Dataset:
    """Return distances, phase maps and what explains the displacements of a frame; see `possible_origin`."""
    import xarray as xr

    fits = {"given": found.given, "one layer": found.one, "two layers": found.two}
    made = {name: fit.quality for name, fit in fits.items() if fit is not None}
    made["any wavefront"] = found.any_wavefront
    layers, said = found.fit.layers, {"verdict": found.verdict, "doubt": found.doubt}
    origin = possible_origin(origin, (layer.ratio for layer in layers))
    distances_m, sigma_m = distances_and_sigma_m(layers, origin, bench)
    x_m, y_m, phase = layer_maps(layers, origin, Layer.phase, points)
    *_, sigma = layer_maps(layers, origin, Layer.sigma, points)
    tried_m, order = tried_distances_m(found.ratios, origin, bench)
    of_distance = from_where(origin)
    return xr.Dataset(
        {
            "distance_m": ("layer", distances_m, about("m", of_distance)),
            "distance_sigma_m": ("layer", sigma_m, about("m", "standard deviation; NaN if given")),
            "layer_phase": (("layer", "y", "x"), phase, about("rad", "phase on the layer; NaN where no ray meets it")),
            "layer_phase_sigma": (("layer", "y", "x"), sigma, about("rad", "standard deviation of layer_phase")),
            "chi_square": ("distance", found.chi_squares[order], about("1", "reduced, of a single layer there")),
            "misfit": ("distance", found.misfits[order], about("1", "unexplained share of the displacements, RMS")),
            "model_chi_square": ("model", [fit.chi_square for fit in made.values()], about("1", "reduced")),
            "model_misfit": ("model", [fit.misfit for fit in made.values()], about("1", "as misfit")),
        },
        coords={
            "distance": ("distance", tried_m, about("m", f"of a single layer; {of_distance}")),
            "x": ("x", x_m, about("m", "on the layer")),
            "y": ("y", y_m, about("m", "on the layer")),
            "model": ("model", list(made)),
        },
        attrs={"title": "Layers of the sample", **said, "distances_from": origin, "ambiguous": _AMBIGUOUS[len(layers)]},
    )


def axis_label(origin: Origin) -> str:
    """Label of a distance axis in mm."""
    return f"distance {_FROM[origin]} (mm)"


def from_where(origin: Origin) -> str:
    """Description of distances for a dataset."""
    return f"distance {_FROM[origin]}{'; negative behind them' * (origin == 'lenslets')}"


def set_distance_axes(axes: Axes, found: xr.Dataset, found_m: Floats) -> None:
    """Make an axis over the distances tried, about those found (layer,), m, and one that begins at 0."""
    origin = found.attrs["distances_from"]
    low_m, high_m = shown_range_m(found_m, found["distance"].values, origin)
    axes.set(xlim=(1e3 * low_m, 1e3 * high_m), ylim=(0, None), xlabel=axis_label(origin))


def draw_layers(found: xr.Dataset) -> Figure:
    """Draw the misfit over the distance, and phase and error of each layer."""
    from app.plotting import Figure
    from app.results.figures import draw_map

    layers = found.sizes["layer"]
    figure = Figure(figsize=(9.6, 3.2 + 3.6 * layers), layout="constrained")
    (top,), (bottom,) = figure.subfigures(2, 1, squeeze=False, height_ratios=[1, 1.3 * layers])
    _draw_curve(top.subplots(), found)
    for layer, (phase, sigma) in enumerate(bottom.subplots(layers, 2, squeeze=False)):
        of_layer = found.isel(layer=layer)
        where = distance_in_words(float(of_layer["distance_m"]), np.nan, found.attrs["distances_from"])
        values, limit = centred(of_layer["layer_phase"].values)
        centred_phase = of_layer["layer_phase"].copy(data=values)
        draw_map(phase, centred_phase, f"phase, {where}", "RdBu_r", (-limit, 0.0, limit))
        phase.set(xlabel="x on the layer (mm)", ylabel="y (mm)")
        sigmas = of_layer["layer_phase_sigma"]
        draw_map(sigma, sigmas, "standard deviation", "viridis", (0.0, float(np.nanpercentile(sigmas, 98))))
    return figure


def _draw_curve(axes: Axes, found: xr.Dataset) -> None:
    """Unexplained share of the displacements over the distance of a single layer."""
    axes.plot(found["distance"] * 1e3, found["misfit"], color="#35739f", marker=".", label="a single layer there")
    any_wavefront = float(found["model_misfit"].sel(model="any wavefront"))
    axes.axhline(any_wavefront, color="0.5", linewidth=0.8, linestyle="--", label="any wavefront")
    origin = found.attrs["distances_from"]
    for at_m, sigma_m in zip(found["distance_m"].values, found["distance_sigma_m"].values, strict=True):
        label = f"layer: {distance_in_words(at_m, sigma_m, origin)}"
        axes.axvline(at_m * 1e3, color="#d1495b", linewidth=1.2, label=label)
        if np.isfinite(sigma_m):
            axes.axvspan((at_m - sigma_m) * 1e3, (at_m + sigma_m) * 1e3, color="#d1495b", alpha=0.2, linewidth=0)
    doubt = ", in doubt: no wavefront fits" * bool(found.attrs["doubt"])
    axes.set(ylabel="unexplained share", title=f"Verdict: {found.attrs['verdict']}{doubt}")
    set_distance_axes(axes, found, found["distance_m"].values)
    axes.legend(fontsize=8)


_SHOWN_POINTS = 65  # along each side of a map in the window
WITHOUT_WAVEFRONT = "there is no wavefront"


def find_shown_layers(
    measurement: Measurement, origin: Origin, *, count: int, check: Callable[[], None]
) -> xr.Dataset | str:
    """Search for `count` layers.

    Distances are measured from the `origin`, if possible. An exception of `check` ends the search. Phases are about the
    middle of their range, half of which is the `phase_limit` (layer,), rad. Returns the problem if there are no layers.
    """
    calibration, wavefront = measurement.calibration, measurement.wavefront
    if calibration is None or wavefront is None:
        return WITHOUT_WAVEFRONT
    try:
        found = search_layers(calibration.reconstructor().layers(wavefront.displacement), count, check=check)
    except ReconstructionError as error:
        return str(error)
    shown = layers_dataset(found, calibration.bench, origin, _SHOWN_POINTS)
    phase = shown["layer_phase"]
    values, limits_rad = zip(*map(centred, phase.values), strict=True)
    return shown.assign(layer_phase=phase.copy(data=np.array(values)), phase_limit=("layer", list(limits_rad)))
