"""Figure of a result: wavefront and point-spread function of every view, transfer and isoplanatism."""

import math
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize, PowerNorm
from matplotlib.figure import Figure, SubFigure

from app.errors import InputError
from app.files import atomic_write
from reconstruction.arrays import Floats
from reconstruction.geometry import Field
from reconstruction.quality.image_quality import Mtf, mtf, psf, psf_angles_rad, psf_reach_rad
from reconstruction.quality.isoplanatism import Isoplanatism, isoplanatism
from reconstruction.wavefront import Wavefront, peak_to_valley, rms

_FORMATS = (".png", ".pdf", ".svg")  # Matplotlib writes others, some by programs that may be missing
_CURVES_HEIGHT = 2.6  # inches
_SMALLEST = 10.0, 4.2  # width of the figure and height of its maps, inches; titles need them


def check_plot_path(path: Path) -> None:
    """Raise `InputError` if the suffix is not a picture format."""
    if path.suffix.lower() not in _FORMATS:
        raise InputError(f"{path}: give a picture's name that ends in one of {', '.join(_FORMATS)}")


def plot_views(wavefront: Wavefront, path: Path) -> None:
    """Draw the views into an image file, +x to the right and +y down as on the camera."""
    with atomic_write(path) as temporary:
        views_figure(wavefront).savefig(temporary, dpi=150)


def views_figure(wavefront: Wavefront) -> Figure:
    """Return the figure of `plot_views`."""
    views, field, sensor = wavefront.views, wavefront.field, wavefront.sensor
    width, height = np.maximum(_SMALLEST, (4.4 * field.view_columns + 2.8, 2.5 * field.view_rows + 0.4))
    figure = Figure(figsize=(width, height + _CURVES_HEIGHT), layout="constrained")
    (maps,), (curves,) = figure.subfigures(2, 1, squeeze=False, height_ratios=[height, _CURVES_HEIGHT])
    ((left, right),) = maps.subfigures(1, 2, squeeze=False)
    limit = float(np.nanmax(np.abs(views), initial=0)) or 1.0
    captions = [[f"RMS {rms(view):.3f}  PV {peak_to_valley(view):.2f} rad" for view in row] for row in views]
    draw_maps(left, views, _with_places(field, captions), ("RdBu_r", Normalize(-limit, limit), "wavefront (rad)"))
    _draw_psf(right, wavefront)
    middle = field.view_rows // 2, field.view_columns // 2
    axes = curves.subplots(1, 2)
    draw_transfer(axes[0], mtf(views[middle], sensor), place(field, *middle))
    draw_structure(axes[1], isoplanatism(wavefront))
    return figure


def draw_maps(
    figure: SubFigure,
    maps: Floats,
    captions: list[list[str]],
    colours: tuple[str, Normalize, str],
    *,
    fontsize: float = 8,
) -> None:
    """Draw a map (row, column) of every view with its caption; NaN is grey.

    `colours` are the name of a colour map, its scale and its title.
    """
    name, scale, title = colours
    axes = figure.subplots(len(captions), len(captions[0]), squeeze=False)
    for (row, column), axis in np.ndenumerate(axes):
        axis.imshow(maps[row, column], cmap=name, norm=scale)
        axis.set_title(captions[row][column], fontsize=fontsize)
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
    captions = [[f"Strehl {one[middle, middle]:.3f}  peak {one.max():.3f}" for one in row] for row in maps]
    scale = PowerNorm(0.5, 0, float(np.nanmax(maps, initial=0)) or 1.0)
    title = f"point-spread function within $\\pm${angle_rad[-1] * 1e3:.2g} mrad (1 = perfect peak)"
    draw_maps(figure, maps, _with_places(wavefront.field, captions), ("inferno", scale, title))


def draw_transfer(axis: Axes, transfer: Mtf, where: str) -> None:
    """Draw the modulation transfer along x and y at a position named `where`."""
    for name, frequency_per_rad, values, limit in (
        ("x", transfer.frequency_x_per_rad, transfer.along_x, transfer.limit_x),
        ("y", transfer.frequency_y_per_rad, transfer.along_y, transfer.limit_y),
    ):
        (line,) = axis.plot(frequency_per_rad / 1e3, values, label=f"along {name}")
        axis.plot(frequency_per_rad / 1e3, limit, "--", linewidth=0.8, color=line.get_color())
    axis.set(title=f"modulation transfer at {where}", xlabel="cycles per mrad", xlim=(0, None), ylim=(0, 1))
    axis.legend(title="- - diffraction limit", fontsize=8, title_fontsize=8)


def draw_structure(axis: Axes, found: Isoplanatism) -> None:
    """Draw the difference of wavefronts over their separation in the field, with and without tilt."""
    for name, curve in (("with tilt", found.curve), ("tilt removed", found.curve_without_tilt)):
        separation_mm = np.append(0.0, curve.separation_m * 1e3)
        rms_rad, least_rad, most_rad = (
            np.append(0.0, values) for values in (curve.rms_rad, curve.least_rad, curve.most_rad)
        )
        (line,) = axis.plot(separation_mm, rms_rad, label=name)
        axis.fill_between(separation_mm, least_rad, most_rad, color=line.get_color(), alpha=0.15, linewidth=0)
    axis.axhline(1.0, linestyle="--", linewidth=0.8, color="0.4")
    title = f"a single correction would leave {found.error_rad:.2f} rad RMS"
    title += f"\n{found.error_without_tilt_rad:.2f} rad without tilt"
    axis.set(title=title, xlabel="separation in the field (mm)", ylabel="wavefront change (rad RMS)", xlim=(0, None))
    axis.set_ylim(0, None)
    axis.legend(fontsize=8)


def place(field: Field, row: int, column: int) -> str:
    """Return the position of a view in words."""
    return f"({field.view_x_m[column] * 1e3:+.2f}, {field.view_y_m[row] * 1e3:+.2f}) mm"


def _with_places(field: Field, captions: list[list[str]]) -> list[list[str]]:
    return [
        [f"{place(field, row, column)}\n{caption}" for column, caption in enumerate(line)]
        for row, line in enumerate(captions)
    ]
