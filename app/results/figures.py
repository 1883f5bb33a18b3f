"""Figures of results as image files: views of a wavefront, and a lattice over its reference."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from app.plotting import Figure

# isort: split
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PolyCollection
from matplotlib.colors import Normalize, PowerNorm, to_rgba
from matplotlib.figure import SubFigure
from numpy.typing import NDArray

from app.results.pictures import step_above
from reconstruction.arrays import Floats
from reconstruction.geometry import Field, Lattice, lenslet_centers
from reconstruction.lattice.cells import cell_index
from reconstruction.lattice.search import Survey
from reconstruction.quality.image_quality import Mtf, mtf, psf, psf_angles_rad, psf_reach_rad
from reconstruction.quality.isoplanatism import Isoplanatism, isoplanatism
from reconstruction.wavefront import Wavefront, peak_to_valley, rms

if TYPE_CHECKING:
    import xarray as xr

_CURVES_HEIGHT = 2.6  # inches
_SHOWN_PERCENT = (0.5, 99.8)  # percentiles at the ends of the grey scale
_LARGEST_POINTS = 8.0  # of the captions of maps
_LETTER = 0.62  # width of a letter over its size, on average
_MAPS_PART = 0.82  # of the width; the rest is for the colour bar
_SMALLEST = 10.0, 4.2  # width of the figure and height of its maps, inches; titles need them


def views_figure(wavefront: Wavefront) -> Figure:
    """Return the figure of the views, +x to the right and +y down as on the camera."""
    views, field = wavefront.views, wavefront.field
    width, height = np.maximum(_SMALLEST, (4.4 * field.view_columns + 2.8, 2.5 * field.view_rows + 0.4))
    figure = Figure(figsize=(width, height + _CURVES_HEIGHT), layout="constrained")
    (maps,), (curves,) = figure.subfigures(2, 1, squeeze=False, height_ratios=[height, _CURVES_HEIGHT])
    ((left, right),) = maps.subfigures(1, 2, squeeze=False)
    limit = float(np.nanmax(np.abs(views), initial=0)) or 1.0

    def caption(*view: int) -> str:
        numbers = f"RMS {rms(views[view]):.3f}  PV {peak_to_valley(views[view]):.2f} rad"
        return f"{place_of_view(field, *view)}\n{numbers}"

    draw_maps(left, views, caption, ("RdBu_r", Normalize(-limit, limit), "wavefront (rad)"))
    _draw_psf(right, wavefront)
    draw_curves(curves, wavefront)
    return figure


def draw_maps(
    figure: SubFigure, maps: Floats, caption: Callable[[int, int], str], colours: tuple[str, Normalize, str]
) -> None:
    """Draw maps (view_row, view_column, row, column), NaN grey, under captions; `colours` are name, scale and title."""
    name, scale, title = colours
    axes = figure.subplots(*maps.shape[:2], squeeze=False)
    captions = {view: caption(*view) for view in np.ndindex(axes.shape)}
    longest = max(len(line) for text in captions.values() for line in text.splitlines())
    width_inches = _MAPS_PART * figure.bbox.width / figure.get_figure(root=True).dpi / axes.shape[1]
    points = min(_LARGEST_POINTS, 72 * width_inches / longest / _LETTER)  # so that neighbours do not touch
    for view, axis in np.ndenumerate(axes):
        axis.imshow(maps[view], cmap=name, norm=scale)
        axis.set_title(captions[view], fontsize=points)
        axis.set_xticks([])
        axis.set_yticks([])
        axis.set_facecolor("0.6")
    figure.colorbar(ScalarMappable(scale, name), ax=axes, label=title, shrink=0.8)


def _draw_psf(figure: SubFigure, wavefront: Wavefront) -> None:
    """Draw the point-spread function of every view out to where there is light."""
    sensor = wavefront.sensor
    reach_rad = psf_reach_rad(wavefront.views, sensor)
    angle_rad = psf_angles_rad(sensor, reach_rad if math.isfinite(reach_rad) else 1e-3)
    maps = psf(wavefront.views, sensor, angle_rad=angle_rad)
    middle = angle_rad.size // 2

    def caption(*view: int) -> str:
        numbers = f"Strehl {maps[view][middle, middle]:.3f}  peak {maps[view].max():.3f}"
        return f"{place_of_view(wavefront.field, *view)}\n{numbers}"

    scale = PowerNorm(0.5, 0, float(np.nanmax(maps, initial=0)) or 1.0)
    title = f"point-spread function within $\\pm${angle_rad[-1] * 1e3:.2g} mrad (1 = perfect peak)"
    draw_maps(figure, maps, caption, ("inferno", scale, title))


def draw_curves(figure: SubFigure, wavefront: Wavefront) -> None:
    """Draw the modulation transfer of the middle view, and wavefront differences over separation."""
    field = wavefront.field
    middle = field.view_rows // 2, field.view_columns // 2
    is_single = wavefront.displacement.modes.count == 1  # one wavefront for the whole field
    left, *right = figure.subplots(1, 1 if is_single else 2, squeeze=False)[0]
    _draw_transfer(left, mtf(wavefront.views[middle], wavefront.sensor), place_of_view(field, *middle))
    for axis in right:
        _draw_structure(axis, isoplanatism(wavefront))


def _draw_transfer(axis: Axes, transfer: Mtf, where: str) -> None:
    for name, frequency_per_rad, values, limit in (
        ("x", transfer.frequency_x_per_rad, transfer.along_x, transfer.limit_x),
        ("y", transfer.frequency_y_per_rad, transfer.along_y, transfer.limit_y),
    ):
        (line,) = axis.plot(frequency_per_rad / 1e3, values, label=f"along {name}")
        axis.plot(frequency_per_rad / 1e3, limit, "--", linewidth=0.8, color=line.get_color())
    axis.set(title=f"modulation transfer at {where}", xlabel="cycles per mrad", xlim=(0, None), ylim=(0, 1))
    axis.legend(title="- - diffraction limit", fontsize=8, title_fontsize=8)


def _draw_structure(axis: Axes, found: Isoplanatism) -> None:
    for name, curve in (("with tilt", found.curve), ("tilt removed", found.curve_without_tilt)):
        separation_mm = np.append(0.0, curve.separation_m * 1e3)
        rms_rad, least_rad, most_rad = np.pad([curve.rms_rad, curve.least_rad, curve.most_rad], ((0, 0), (1, 0)))
        (line,) = axis.plot(separation_mm, rms_rad, label=name)
        axis.fill_between(separation_mm, least_rad, most_rad, color=line.get_color(), alpha=0.15, linewidth=0)
    axis.axhline(1.0, linestyle="--", linewidth=0.8, color="0.4")
    title = f"a single correction would leave {found.error_rad:.2f} rad RMS"
    title += f"\n{found.error_without_tilt_rad:.2f} rad without tilt"
    axis.set(title=title, xlabel="separation in the field (mm)", ylabel="wavefront change (rad RMS)", xlim=(0, None))
    axis.set_ylim(0, None)
    axis.legend(fontsize=8)


def draw_map(axes: Axes, values: xr.DataArray, title: str, colours: str, ticks: tuple[float, ...]) -> None:
    """Draw a map (y, x) over positions in mm, with a colour bar from the first to the last tick, rad."""
    edges_mm = [1e3 * float(values[name].max()) for name in ("x", "y")]  # middle of the last pixel
    x_mm, y_mm = (edge + (edge / max(size - 1, 1) or 0.5) for edge, size in zip(edges_mm, values.T.shape, strict=True))
    image = axes.imshow(values, cmap=colours, vmin=ticks[0], vmax=ticks[-1], extent=(-x_mm, x_mm, y_mm, -y_mm))
    axes.set_title(title, fontsize=8.5)
    axes.locator_params(nbins=4)
    axes.tick_params(labelsize=7)
    axes.set_facecolor("0.9")
    bar = axes.figure.colorbar(image, ax=axes, location="bottom", shrink=0.9, ticks=ticks, format="%.2g rad")
    bar.ax.tick_params(labelsize=7)


def place_of_view(field: Field, row: int, column: int) -> str:
    """Return the position of a view in words."""
    return f"({field.view_x_m[column] * 1e3:+.2f}, {field.view_y_m[row] * 1e3:+.2f}) mm"


_LIT, _DARK, _BESIDE, _CUT = "#35d0ba", "#ff5a5f", "#ffd166", "#9aa5b1"
_CENTER = "#d1495b"


def lattice_figure(reference: NDArray[Any], found: Survey) -> Figure:
    """Return a figure: reference (row, column), counts, with cells, typical lenslet, and all displacements."""
    lattice, lit = found.lattice, found.illuminated
    figure = Figure(figsize=(13.6, 10.2), layout="constrained")
    grid = figure.add_gridspec(2, 2, width_ratios=[2.35, 1])
    figure.suptitle(
        f"pitch {lattice.pitch_text(3)}, rotation {lattice.rotation_rad * 1e3:+z.2f} mrad,"
        f" centre ({lattice.center_x_px:.2f}, {lattice.center_y_px:.2f}) px\n"
        f"{found.rows} x {found.columns} lenslets, {lit.sum()} of the sensor's {lit.size} with light,"
        f" {found.residual_px:.3f} px RMS off the lattice"
    )
    _draw_frame(figure.add_subplot(grid[:, 0]), reference, found)
    _draw_typical(figure.add_subplot(grid[0, 1]), found)
    _draw_displacement(figure.add_subplot(grid[1, 1]), found)
    figure.legend(loc="outside lower center", ncols=5, frameon=False)
    return figure


def _draw_frame(axes: Axes, reference: NDArray[Any], found: Survey) -> None:
    lattice, lit = found.lattice, found.illuminated
    darkest, brightest = np.percentile(reference, _SHOWN_PERCENT)
    axes.imshow(reference, cmap="gray", vmin=darkest, vmax=brightest)
    own = lenslet_centers(lattice.arrangement, *lit.shape)
    beside, cut = _others(lattice, lit.shape, reference.shape)
    width = np.clip(lattice.pitch_px / 25, 0.4, 1.3)
    for position, colour, style, name in (
        (cut, _CUT, ":", "cut by the frame's edge"),
        (beside, _BESIDE, "--", "whole, not among the sensor's lenslets"),
        (own[lit], _LIT, "-", "with light"),
        (own[~lit], _DARK, "-", "dark"),
    ):
        corners = lattice.camera_px(position[:, None] + 0.94 * lattice.cell_corners)
        face = to_rgba(colour, 0.22) if colour == _DARK else "none"
        cells = PolyCollection(list(corners), facecolors=face, edgecolors=colour, linestyles=style, linewidths=width)
        cells.set_label(f"{len(position)} {name}")
        if len(position):
            axes.add_collection(cells)
    center = lattice.center_x_px, lattice.center_y_px
    axes.plot(*center, "+", color="white", markersize=14, markeredgewidth=3)
    axes.plot(*center, "+", color=_CENTER, markersize=13, markeredgewidth=1.4, label="centre")
    rows, columns = reference.shape
    axes.set(xlim=(-0.5, columns - 0.5), ylim=(rows - 0.5, -0.5), xlabel="x (px)", ylabel="y (px)")


def _draw_typical(axes: Axes, found: Survey) -> None:
    (left_px, top_px), _, (right_px, bottom_px), _ = found.lattice.cell_corners @ found.lattice.pitch_matrix_px
    axes.imshow(found.typical, cmap="gray", extent=(left_px, right_px, bottom_px, top_px))
    axes.axhline(0, color=_CENTER, linewidth=0.8)
    axes.axvline(0, color=_CENTER, linewidth=0.8)
    axes.set_title(f"the typical lenslet; the others are alike to {100 * found.likeness:.0f} %", fontsize=10)
    axes.set(xlabel="from the lenslet's centre (px)", ylabel="px")


def _draw_displacement(axes: Axes, found: Survey) -> None:
    rows, columns = found.illuminated.shape
    x, y = np.meshgrid(np.arange(columns, dtype=np.float64), np.arange(rows))
    if found.lattice.arrangement == "hexagonal":
        x[1::2] += 0.5
    shift = found.displacement_px
    largest_px = float(np.nanmax(np.hypot(*np.moveaxis(shift, -1, 0)), initial=0)) or 1.0
    arrow_px = step_above(largest_px / 2, (1.0, 2.0, 5.0))
    arrows = axes.quiver(
        *(x, y, shift[..., 0], shift[..., 1]),
        angles="xy",
        scale_units="xy",
        scale=arrow_px,
        width=0.004,
        color="#1d7874",
        pivot="tail",
    )
    axes.plot(x[~found.illuminated], y[~found.illuminated], "x", color=_DARK, markersize=5)
    axes.quiverkey(arrows, 0.93, -0.17, arrow_px, f"{arrow_px:g} px", labelpos="W", fontproperties={"size": 9})
    axes.set(xlim=(-1, columns), ylim=(rows, -1), aspect=found.lattice.row_spacing)
    axes.set(xlabel="lenslet column", ylabel="lenslet row")
    axes.set_title("each lenslet's light next to the lattice", fontsize=10)


def _others(lattice: Lattice, own: tuple[int, ...], shape: tuple[int, ...]) -> tuple[Floats, Floats]:
    """Cells outside the `own` rows and columns, in pitches: whole ones, and those that the frame cuts."""
    first = lenslet_centers(lattice.arrangement, own[0], own[1])[0, 0]
    center_x_px, center_y_px = lattice.camera_px(first)
    on_the_first = replace(lattice, center_x_px=float(center_x_px), center_y_px=float(center_y_px))
    whole, cut = (cell_index(on_the_first, (shape[0], shape[1]), only_partial=some) for some in (False, True))
    beside, beside_cut = (each[~np.all((each >= 0) & (each < own[::-1]), axis=1)] for each in (whole, cut))
    return first + lattice.cell_positions(beside), first + lattice.cell_positions(beside_cut)
