"""Figure of a lattice over its reference: lit and dark cells, cells outside the sensor, cells cut by the edge."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from numpy.typing import NDArray

from app.files import atomic_write
from reconstruction.arrays import Floats
from reconstruction.geometry import Lattice, lenslet_centers
from reconstruction.lattice.cells import cell_index
from reconstruction.lattice.search import Survey

_SHOWN_PERCENT = (0.5, 99.8)  # percentiles at the ends of the grey scale
_LIT, _DARK, _BESIDE, _CUT = "#35d0ba", "#ff5a5f", "#ffd166", "#9aa5b1"
_CENTER = "#d1495b"


def plot_lattice(reference: NDArray[Any], found: Survey, path: Path) -> None:
    """Draw the lattice over the reference (row, column) into an image file."""
    with atomic_write(path) as temporary:
        lattice_figure(reference, found).savefig(temporary, dpi=150)


def lattice_figure(reference: NDArray[Any], found: Survey) -> Figure:
    """Return the figure: the frame with its cells, the typical lenslet, and each lenslet's displacement."""
    lattice, lit = found.lattice, found.illuminated
    figure = Figure(figsize=(13.6, 10.2), layout="constrained")
    grid = figure.add_gridspec(2, 2, width_ratios=[2.35, 1])
    figure.suptitle(
        f"pitch {lattice.pitch_px:.3f} px, rotation {lattice.rotation_rad * 1e3:+z.2f} mrad,"
        f" centre ({lattice.center_x_px:.2f}, {lattice.center_y_px:.2f}) px\n"
        f"{found.rows} x {found.columns} whole lenslets, {lit.sum()} of the sensor's {lit.size} lit,"
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
        (beside, _BESIDE, "--", "whole, beside the sensor's lenslets"),
        (own[lit], _LIT, "-", "lit"),
        (own[~lit], _DARK, "-", "dark"),
    ):
        corners = lattice.to_camera_px((position[:, None] + 0.94 * lattice.cell_corners) * lattice.pitch_px)
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
    (left_px, top_px), _, (right_px, bottom_px), _ = found.lattice.cell_corners * found.lattice.pitch_px
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
    arrow_px = _round_number(largest_px)
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
    axes.set_title("each lenslet's light beside the lattice", fontsize=10)


def _others(lattice: Lattice, own: tuple[int, ...], shape: tuple[int, ...]) -> tuple[Floats, Floats]:
    """Cells outside the `own` rows and columns, in pitches: whole ones, and those cut by the edge of the frame."""
    first = lenslet_centers(lattice.arrangement, own[0], own[1])[0, 0]
    center_x_px, center_y_px = lattice.to_camera_px(first * lattice.pitch_px)
    on_the_first = replace(lattice, center_x_px=float(center_x_px), center_y_px=float(center_y_px))
    whole, cut = (cell_index(on_the_first, (shape[0], shape[1]), partial=partial) for partial in (False, True))
    is_own = np.all((whole >= 0) & (whole < own[::-1]), axis=1)
    return first + lattice.cell_positions(whole[~is_own]), first + lattice.cell_positions(cut)


def _round_number(value: float) -> float:
    """Round down to 1, 2 or 5 times a power of ten."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(max(step for step in (1, 2, 5) if step * power <= value * 1.000001) * power)
