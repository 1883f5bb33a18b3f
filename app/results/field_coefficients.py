"""Coefficients over the field (docs/field.md): dataset, table, figure, double Zernikes."""

from collections.abc import Iterator, Sequence

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase

from app.errors import SETTINGS_CHANGED, InputError
from app.results.mode_coefficients import mode_names
from app.results.result_file import Variable, about
from reconstruction.arrays import Floats
from reconstruction.errors import ReconstructionError
from reconstruction.field_coefficients import FieldCoefficients, ModalFit, field_coefficients
from reconstruction.geometry import Field, Sensor
from reconstruction.quality.verdict import Quality
from reconstruction.wavefront import Wavefront


def field_dataset(
    found: FieldCoefficients, sensor: Sensor, field: Field, positions: int, field_order: int | None = None
) -> xr.Dataset:
    """Return the maps of `coefficient_maps`, and Zernike coefficients also as double Zernikes."""
    maps = coefficient_maps(found, field, positions)
    if found.basis == "legendre":
        return maps
    return maps.assign(double_zernike_variables(found, field_order)).assign_attrs(circles(sensor, field))


def coefficient_maps(found: FieldCoefficients, field: Field, positions: int) -> xr.Dataset:
    """Return the coefficients, without the piston, at positions x positions evenly spread over the field."""
    if positions < 1:
        raise InputError(f"the positions across the field must be at least 1, not {positions}")
    x = np.linspace(-1, 1, positions) if positions > 1 else np.zeros(1)
    y = x[:, None]
    outside = ~field.contains(x, y)
    values, sigma = found.at(x, y)[1:], found.sigma(x, y)[1:]
    values[:, outside] = sigma[:, outside] = np.nan
    maps, first = ("mode", "y", "x"), int(found.basis == "zernike")
    at_m = x * field.half_width_m
    numbers = np.arange(1, len(found.rad)) + first
    count = "Noll's count, from 1" if first else "the paper's count, from 0"
    return xr.Dataset(
        {
            "coefficient": (maps, values, about("rad", f"coefficients in {found.basis} modes")),
            "coefficient_sigma": (maps, sigma, about("rad", "standard deviation of coefficient")),
        },
        coords={
            "mode": ("mode", numbers, about("1", count)),
            "name": ("mode", list(mode_names(found.basis, len(found.rad))[1:])),
            "x": ("x", at_m, about("m", "field position")),
            "y": ("y", at_m, about("m", "field position")),
        },
        attrs={"title": "Coefficients over the field", "basis": found.basis, "known_share": found.known_share},
    )


def double_zernike_variables(found: FieldCoefficients, field_order: int | None = None) -> dict[str, Variable]:
    """Return double Zernikes and their standard deviations as variables of a dataset."""
    dimensions = ("k", "j")
    rad, sigma = found.double_zernikes(field_order)
    long_name = "d[k, j] Z_k(field) Z_j(pupil), Noll's counts from 1; the first row and column are unused"
    return {
        "double_zernike": (dimensions, rad, about("rad", long_name)),
        "double_zernike_sigma": (dimensions, sigma, about("rad", "standard deviation of double_zernike")),
    }


def circles(sensor: Sensor, field: Field) -> dict[str, float]:
    """Return the radii of the double Zernikes' circles as attributes, named as GalSim names its arguments."""
    radius_m = min(sensor.pupil_half_width_m)
    return {"uv_outer": field.half_width_m, "uv_inner": 0.0, "xy_outer": radius_m, "xy_inner": 0.0}


def table_names(found: FieldCoefficients) -> list[str]:
    """Return the columns of a table: field position, coefficients and standard deviations, with their units."""
    modes = [name.split(" ", 1)[0] for name in mode_names(found.basis, len(found.rad))[1:]]
    return ["x_m", "y_m", *(f"{mode}_rad" for mode in modes), *(f"{mode}_sigma_rad" for mode in modes)]


def table_rows(found: FieldCoefficients, field: Field, x_m: Floats, y_m: Floats) -> Iterator[list[float]]:
    """Yield a row for every position inside the field of the grid x_m (x,), y_m (y,)."""
    x, y = (grid.ravel() / field.half_width_m for grid in np.meshgrid(x_m, y_m))
    inside = field.contains(x, y)
    x, y = x[inside], y[inside]
    place_m = np.stack([x, y]) * field.half_width_m
    yield from np.concatenate([place_m, found.at(x, y)[1:], found.sigma(x, y)[1:]]).T.tolist()


STRONGEST = 6  # maps by default
_PAIRS = 2  # of value and error side by side


def strongest(maps: xr.Dataset, count: int = STRONGEST) -> list[int]:
    """Return the numbers of the modes with the largest RMS over the field, the largest first."""
    mean_square = (maps["coefficient"] ** 2).mean(("y", "x")).values
    return [int(number) for number in maps["mode"].values[np.argsort(-mean_square)[:count]]]


def field_figure(maps: xr.Dataset, modes: Sequence[int]) -> Figure:
    """Return the figure of modes of a dataset of coefficients."""
    rows = -(-len(modes) // _PAIRS)
    figure = Figure(figsize=(4.4 * min(_PAIRS, len(modes)), 2.9 * rows), layout="constrained")
    draw_field(figure, maps, modes)
    return figure


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


def double_zernikes(wavefront: Wavefront, _quality: Quality | None = None) -> xr.Dataset:
    """Return the double Zernikes of a wavefront with their standard deviations."""
    attributes = {"title": "Double Zernike coefficients", **circles(wavefront.sensor, wavefront.field)}
    return xr.Dataset(double_zernike_variables(_zernikes(wavefront)), attrs=attributes)


def zernike_names(wavefront: Wavefront) -> list[str]:
    """Return the columns of the table of a recording."""
    return ["frame", *table_names(_zernikes(wavefront))]


def zernike_rows(frame: int, wavefront: Wavefront, names: list[str]) -> Iterator[list[float]]:
    """Yield the rows of a frame, one for each view inside the field."""
    found, field = _zernikes(wavefront), wavefront.field
    if ["frame", *table_names(found)] != names:
        raise InputError(SETTINGS_CHANGED)
    for row in table_rows(found, field, field.view_x_m, field.view_y_m):
        yield [frame, *row]


def _zernikes(wavefront: Wavefront) -> FieldCoefficients:
    try:
        return field_coefficients(ModalFit.of(wavefront), "zernike")
    except ReconstructionError as error:
        raise InputError(f"the wavefront cannot be written in Zernike modes: {error}") from error


def field_sentences(maps: xr.Dataset) -> list[str]:
    """Return the strongest coefficients in sentences, as mean and range over the field."""
    lines = []
    for number in strongest(maps):
        of_mode = maps.sel(mode=number)
        values, sigma = of_mode["coefficient"], float(of_mode["coefficient_sigma"].mean())
        lines.append(
            f"{of_mode['name'].item()}: mean {float(values.mean()):+.3f} rad,"
            f" {float(values.min()):+.3f} ... {float(values.max()):+.3f} over the field, error {sigma:.2g} rad"
        )
    if (share := maps.attrs["known_share"]) < 1:
        lines.append(f"{100 * (1 - share):.0f} % of the lenslets in the pupil are unknown: the modes bridge them")
    return lines
