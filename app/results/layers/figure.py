"""Figure of the layers: misfit over the distance, phase maps and their error bars."""

from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from app.files import atomic_write
from app.results.layers.dataset import axis_label, centred, distance_in_words, shown_range_m


def plot_layers(found: xr.Dataset, path: Path) -> None:
    """Draw a dataset of layers into an image file."""
    with atomic_write(path) as temporary:
        layers_figure(found).savefig(temporary, dpi=150)


def layers_figure(found: xr.Dataset) -> Figure:
    """Return the figure: the curve on top, below it phase and error of each layer."""
    layers = found.sizes["layer"]
    figure = Figure(figsize=(9.6, 3.2 + 3.6 * layers), layout="constrained")
    (top,), (bottom,) = figure.subfigures(2, 1, squeeze=False, height_ratios=[1, 1.3 * layers])
    _draw_curve(top.subplots(), found)
    for layer, (phase, sigma) in enumerate(bottom.subplots(layers, 2, squeeze=False)):
        of_layer = found.isel(layer=layer)
        where = distance_in_words(float(of_layer["distance_m"]), np.nan, found.attrs["distances_from"])
        values, limit = centred(of_layer["layer_phase"].values)
        centred_phase = of_layer["layer_phase"].copy(data=values)
        _draw_map(phase, centred_phase, f"phase (rad), {where}", "RdBu_r", (-limit, limit))
        sigmas = of_layer["layer_phase_sigma"]
        _draw_map(sigma, sigmas, "standard deviation (rad)", "viridis", (0, float(np.nanpercentile(sigmas, 98))))
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
    low_m, high_m = shown_range_m(found["distance_m"].values, found["distance"].values, origin)
    axes.set(
        xlim=(1e3 * low_m, 1e3 * high_m),
        ylim=(0, None),
        xlabel=axis_label(origin),
        ylabel="unexplained share",
        title=f"Verdict: {found.attrs['verdict']}{', in doubt: no wavefront fits' if found.attrs['doubt'] else ''}",
    )
    axes.legend(fontsize=8)


def _draw_map(axes: Axes, values: xr.DataArray, title: str, colours: str, limits: tuple[float, float]) -> None:
    x_mm, y_mm = (values[name].values * 1e3 for name in ("x", "y"))
    image = axes.imshow(
        values, cmap=colours, vmin=limits[0], vmax=limits[1], extent=(x_mm[0], x_mm[-1], y_mm[-1], y_mm[0])
    )
    axes.set(xlabel="x on the layer (mm)", ylabel="y (mm)")
    axes.set_title(title, fontsize=9)
    axes.figure.colorbar(image, ax=axes, shrink=0.85)
