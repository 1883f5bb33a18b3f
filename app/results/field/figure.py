"""Full-field display: maps of coefficients over the field, each beside its standard deviation."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase

from app.files import atomic_write

STRONGEST = 6  # maps by default
_PAIRS = 2  # of value and error side by side


def strongest(maps: xr.Dataset, count: int = STRONGEST) -> list[int]:
    """Return the numbers of the modes with the largest RMS over the field, the largest first."""
    mean_square = (maps["coefficient"] ** 2).mean(("y", "x")).values
    return [int(number) for number in maps["mode"].values[np.argsort(-mean_square)[:count]]]


def plot_field(maps: xr.Dataset, modes: Sequence[int], path: Path) -> None:
    """Draw modes of a dataset of coefficients into an image file."""
    rows = -(-len(modes) // _PAIRS)
    figure = Figure(figsize=(4.4 * min(_PAIRS, len(modes)), 2.9 * rows), layout="constrained")
    draw_field(figure, maps, modes)
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=130)


def draw_field(figure: FigureBase, maps: xr.Dataset, modes: Sequence[int]) -> None:
    """Draw coefficients beside their standard deviations, +x to the right and +y down as on the camera."""
    pairs = min(_PAIRS, len(modes))
    axes = figure.subplots(-(-len(modes) // pairs), 2 * pairs, squeeze=False)
    for number, value, error in zip(modes, axes[:, ::2].ravel(), axes[:, 1::2].ravel(), strict=False):
        of_mode = maps.sel(mode=number)
        name = str(of_mode["name"].item()).replace(" ", "\n", 1)
        sigma = of_mode["coefficient_sigma"]
        limit = float(np.abs(of_mode["coefficient"]).max()) or 1.0
        _draw_map(value, of_mode["coefficient"], name, "RdBu_r", (-limit, 0.0, limit))
        _draw_map(error, sigma, "standard\ndeviation", "viridis", (0.0, float(sigma.max()) or 1.0))
    for unused in axes.ravel()[2 * len(modes) :]:
        unused.set_axis_off()
    axes[-1, 0].set_xlabel("field x (mm)", fontsize=7.5)
    axes[-1, 0].set_ylabel("y (mm)", fontsize=7.5)


def _draw_map(axes: Axes, values: xr.DataArray, title: str, colours: str, ticks: tuple[float, ...]) -> None:
    """Draw a map with a colour bar from the first to the last tick, rad."""
    edge_mm = float(values["x"].max()) * 1e3
    half_mm = edge_mm / max(values["x"].size - 1, 1) or 0.5  # of a pixel
    reach_mm = edge_mm + half_mm
    extent = (-reach_mm, reach_mm, reach_mm, -reach_mm)
    image = axes.imshow(values, cmap=colours, vmin=ticks[0], vmax=ticks[-1], extent=extent)
    axes.set_title(title, fontsize=8.5)
    axes.set_xticks([-edge_mm, 0, edge_mm] if edge_mm else [0])
    axes.set_yticks(axes.get_xticks())
    axes.tick_params(labelsize=7)
    axes.set_facecolor("0.9")
    bar = axes.figure.colorbar(image, ax=axes, location="bottom", shrink=0.9, ticks=ticks, format="%.2g rad")
    bar.ax.tick_params(labelsize=7)
