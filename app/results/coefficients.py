"""Coefficients of modes with error bars: of one wavefront, and over the field (docs/field.md)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from app.errors import InputError
from app.results.result_file import about
from app.results.sources import measured
from reconstruction.arrays import Floats
from reconstruction.errors import ReconstructionError
from reconstruction.field_coefficients import FieldCoefficients, ModalFit, fit_at_lenslets, fit_coefficients
from reconstruction.geometry import Field, Sensor
from reconstruction.modes.polynomials import ORDERS, ZernikeOrder, zernike_amplitudes, zernike_names, zernike_numbers
from reconstruction.modes.pupil_modes import BASES
from reconstruction.quality.verdict import Quality
from reconstruction.settings import PupilBasis
from reconstruction.solve.modal import ModalSolution
from reconstruction.wavefront import Wavefront

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.figure import Figure, FigureBase

MAP_ACROSS = 21  # positions across the field, unless another number is chosen
FIELD_BASIS: PupilBasis = "zernike"  # unless another is chosen


@dataclass(frozen=True, slots=True)
class ModeChoice:
    """Selection of the coefficients to compute."""

    basis: PupilBasis
    field_mode: int | None  # e_pq of this field mode q; None: the modes of the selected view
    view: tuple[int, int]  # the selected view
    mapped: int | None = None  # mode whose coefficient is mapped over the field


@dataclass(frozen=True, slots=True, eq=False)
class ModeCoefficients:
    """Coefficients of the modes but the piston, which is always first."""

    choice: ModeChoice
    names: tuple[str, ...]  # (pupil_mode,)
    rad: Floats  # (pupil_mode,); NaN if nothing is known of the wavefront
    sigma_rad: Floats  # standard deviation for a single frame, (pupil_mode,); NaN where unknown
    field_map: Floats | None  # of the mapped mode, rad, (row, column); NaN outside the field

    def table(self, unit: str, per_rad: float) -> str:
        """Return name, value and standard deviation of each mode in a unit as tab-separated lines."""
        numbers = zip(self.names[1:], self.rad[1:] * per_rad, self.sigma_rad[1:] * per_rad, strict=True)
        rows = [f"{name}\t{value:.7g}\t{sigma:.7g}" for name, value, sigma in numbers]
        return "\n".join([f"mode\tvalue ({unit})\tstandard deviation ({unit})", *rows])


def mode_coefficients(wavefront: Wavefront, choice: ModeChoice) -> ModeCoefficients:
    """Fit modes to the wavefront, of a view or field mode, at known lenslets, Zernike modes in the circle."""
    sensor, displacement, solution = wavefront.sensor, wavefront.displacement, wavefront.solution
    if choice.field_mode is None:
        (row, column), field = choice.view, wavefront.field
        x, y = field.view_x_m[column] / field.half_width_m, field.view_y_m[row] / field.half_width_m
        weights, phase = displacement.modes.values(x, y), wavefront.views[choice.view]
    else:
        weights = np.eye(displacement.modes.count)[choice.field_mode]
        phase = solution.wavefront(weights)
    fit = _fit(sensor, choice.basis, np.isfinite(phase).tobytes())
    names = BASES[choice.basis].names(len(fit))
    sigma_rad = np.full(len(fit), np.nan)
    if isinstance(solution, ModalSolution):
        deviations = np.moveaxis(solution.deviations(weights).astype(np.float64), -1, 0)
        sigma_rad = np.linalg.norm(_apply(fit, deviations), axis=0)
    field_map = None
    if choice.mapped is not None:
        by_mode = _apply(fit, solution.wavefront(np.eye(displacement.modes.count)))[:, choice.mapped]
        steps = evenly_spread(MAP_ACROSS)
        field_map = np.tensordot(by_mode, displacement.modes.values(steps, steps[:, None]), axes=1)
        field_map[~wavefront.field.contains(steps, steps[:, None])] = np.nan
    return ModeCoefficients(choice, names, _apply(fit, phase[None])[0], sigma_rad, field_map)


@lru_cache(maxsize=8)
def _fit(sensor: Sensor, basis: PupilBasis, known_bytes: bytes) -> Floats:
    """Matrix (pupil_mode, lenslet) from wavefront to coefficients; zero for unused lenslets."""
    known = np.frombuffer(known_bytes, np.bool_).reshape(sensor.lenslets)
    return fit_at_lenslets(sensor, basis, known)[1]


def _apply(fit: Floats, phases: Floats) -> Floats:
    """Coefficients (case, pupil_mode) of wavefronts (case, lenslet_row, lenslet_column)."""
    return np.asarray(np.nan_to_num(phases.reshape(len(phases), -1)) @ fit.T)


def field_coefficients(
    wavefront: Wavefront,
    basis: PupilBasis = FIELD_BASIS,
    *,
    degree: int | None = None,
    positions: int = MAP_ACROSS,
    order: ZernikeOrder = "noll",
) -> xr.Dataset:
    """Map the coefficients of a wavefront over the field, with double Zernikes (docs/field.md).

    Parameters
    ----------
    wavefront
        A wavefront. To one of the zonal method, Zernike modes are fitted at the lenslet centres.
    basis
        Zernike modes over the circle or annulus of the pupil, or Legendre modes over the whole lattice.
    degree
        Highest degree of the modes; by default all that were fitted, which is exact.
    positions
        Number of field positions along each side.
    order
        Order and normalisation of Zernike modes: "noll", "osa" or "fringe". Double Zernikes are always Noll's.

    Returns
    -------
    xarray.Dataset
        `coefficient(mode, y, x)` and `coefficient_sigma` in rad, at field positions in m. With Zernike modes also
        `double_zernike(k, j)` and `double_zernike_sigma` in rad, and the radii of field and pupil, m, as attributes,
        named as the arguments of `galsim.zernike.DoubleZernike`.

    Raises
    ------
    ReconstructionError
        If the wavefront has no coefficients of this degree.

    Examples
    --------
    >>> field = svwfs.field_coefficients(wavefront, degree=4)
    >>> field["coefficient"].sel(mode=4)["name"].item()  # Noll's count
    'Z4 defocus'
    """
    from app.measurement.offline_reconstructor import whole_number

    degree = None if degree is None else whole_number(degree, "degree")
    found = fit_coefficients(ModalFit.of(measured(wavefront)), basis, degree)
    positions = whole_number(positions, "positions")
    return field_dataset(found, wavefront.sensor, wavefront.field, positions=positions, order=order)


def field_dataset(
    found: FieldCoefficients,
    sensor: Sensor,
    field: Field,
    *,
    positions: int,
    field_order: int | None = None,
    order: ZernikeOrder = "noll",
) -> xr.Dataset:
    """Return maps at positions x positions over the field; of Zernike modes also double Zernikes."""
    if positions < 1:
        raise InputError(f"the positions across the field must be at least 1, not {positions}")
    if order not in ORDERS:
        raise InputError(f"there is no order {order!r} of Zernike modes: it must be one of {', '.join(ORDERS)}")
    maps = coefficient_maps(found, field, *[evenly_spread(positions)] * 2, order=order)
    if found.basis != "zernike":
        return maps
    zernikes = _double_zernikes(found, sensor, field, field_order)
    return maps.assign(zernikes.data_vars).assign_attrs(zernikes.attrs | maps.attrs)


def coefficient_maps(
    found: FieldCoefficients, field: Field, x: Floats, y: Floats, *, order: ZernikeOrder = "noll"
) -> xr.Dataset:
    """Return the coefficients but the piston on a grid x (column,), y (row,) over half the field's width."""
    import xarray as xr

    y, count, maps = y[:, None], len(found.rad), ("mode", "y", "x")
    numbers, names, about_numbers = np.arange(count), BASES[found.basis].names(count), "the paper's count, from 0"
    scale = np.ones(count)
    if found.basis == "zernike":
        numbers, names = np.array(zernike_numbers(count, order)), zernike_names(count, order)
        about_numbers = ORDERS[order]
        scale = zernike_amplitudes(count) if order == "fringe" else scale
    by_number = np.argsort(numbers)[1:]
    outside = ~field.contains(x, y)
    values, sigma = (each[by_number] * scale[by_number, None, None] for each in (found.at(x, y), found.sigma(x, y)))
    values[:, outside] = sigma[:, outside] = np.nan
    return xr.Dataset(
        {
            "coefficient": (maps, values, about("rad", f"coefficients in {found.basis} modes")),
            "coefficient_sigma": (maps, sigma, about("rad", "standard deviation of coefficient")),
        },
        coords={
            "mode": ("mode", numbers[by_number], about("1", about_numbers)),
            "name": ("mode", [names[number] for number in by_number]),
            "x": ("x", x * field.half_width_m, about("m", "field position")),
            "y": ("y", y[:, 0] * field.half_width_m, about("m", "field position")),
        },
        attrs={
            "title": "Coefficients over the field",
            "basis": found.basis,
            "order": about_numbers,
            "known_share": found.known_share,
        },
    )


def evenly_spread(positions: int) -> Floats:
    """Return positions (N,) across the field, over half its width."""
    return np.linspace(-1, 1, positions) if positions > 1 else np.zeros(1)


def table_of(maps: xr.Dataset) -> tuple[list[str], list[list[float]]]:
    """Return columns with units and rows of a table: field positions, coefficients, their errors."""
    modes = [name.split(" ", 1)[0] for name in maps["name"].values]
    names = ["x_m", "y_m", *(f"{mode}_rad" for mode in modes), *(f"{mode}_sigma_rad" for mode in modes)]
    values, sigma = maps["coefficient"].values, maps["coefficient_sigma"].values
    inside = np.isfinite(values[0])
    place_m = np.stack(np.meshgrid(maps["x"], maps["y"]))
    return names, np.concatenate([each[:, inside] for each in (place_m, values, sigma)]).T.tolist()


def _double_zernikes(found: FieldCoefficients, sensor: Sensor, field: Field, order: int | None = None) -> xr.Dataset:
    """Double Zernikes with standard deviations, and radii of their circles under GalSim's names."""
    import xarray as xr

    dimensions, radius_m = ("k", "j"), sensor.circle.radius_m or 0.0
    rad, sigma = found.double_zernikes(order)
    long_name = "d[k, j] Z_k(field) Z_j(pupil), Noll's counts from 1; the first row and column are unused"
    variables = {
        "double_zernike": (dimensions, rad, about("rad", long_name)),
        "double_zernike_sigma": (dimensions, sigma, about("rad", "standard deviation of double_zernike")),
    }
    circles = {"uv_outer": field.half_width_m, "uv_inner": 0.0, "xy_outer": radius_m}
    circles |= {"xy_inner": radius_m * sensor.circle.obscuration}
    return xr.Dataset(variables, attrs={"title": "Double Zernike coefficients", **circles})


STRONGEST = 6  # maps by default
_PAIRS = 2  # of value and error side by side


def strongest(maps: xr.Dataset, count: int = STRONGEST) -> list[int]:
    """Return the numbers of the modes with the largest RMS over the field, the largest first."""
    mean_square = (maps["coefficient"] ** 2).mean(("y", "x")).values
    return [int(number) for number in maps["mode"].values[np.argsort(-mean_square)[:count]]]


def coefficient_sentences(maps: xr.Dataset) -> list[str]:
    """Say the strongest coefficients, as mean and range over the field."""
    lines = []
    for number in strongest(maps):
        of_mode = maps.sel(mode=number)
        values, sigma = of_mode["coefficient"], float(of_mode["coefficient_sigma"].mean())
        lines.append(
            f"{of_mode['name'].item()}: mean {float(values.mean()):+.3f} rad,"
            f" {float(values.min()):+.3f} ... {float(values.max()):+.3f} over the field, error"
            f" {f'{sigma:.2g} rad' if np.isfinite(sigma) else 'unknown'}"
        )
    if (share := maps.attrs["known_share"]) < 1:
        lines.append(f"{100 * (1 - share):.0f} % of the lenslets in the pupil are unknown: the modes bridge them")
    return lines


def field_figure(maps: xr.Dataset, modes: Sequence[int]) -> Figure:
    """Return the figure of these modes, see `draw_field`."""
    from app.plotting import Figure

    figure = Figure(figsize=(4.4 * min(_PAIRS, len(modes)), 2.9 * -(-len(modes) // _PAIRS)), layout="constrained")
    draw_field(figure, maps, modes)
    return figure


def draw_field(figure: FigureBase, maps: xr.Dataset, modes: Sequence[int]) -> None:
    """Draw coefficients beside their standard deviations, +x to the right and +y down as on the camera."""
    from app.results.figures import draw_map

    pairs = min(_PAIRS, len(modes))
    axes = figure.subplots(-(-len(modes) // pairs), 2 * pairs, squeeze=False)
    for number, value, error in zip(modes, axes[:, ::2].ravel(), axes[:, 1::2].ravel(), strict=False):
        of_mode = maps.sel(mode=number)
        name = str(of_mode["name"].item()).replace(" ", "\n", 1)
        sigma = of_mode["coefficient_sigma"]
        limit = float(np.abs(of_mode["coefficient"]).max()) or 1.0
        draw_map(value, of_mode["coefficient"], name, "RdBu_r", (-limit, 0.0, limit))
        draw_map(error, sigma, "standard\ndeviation", "viridis", (0.0, float(sigma.fillna(0.0).max()) or 1.0))
    for unused in axes.ravel()[2 * len(modes) :]:
        unused.set_axis_off()
    axes[-1, 0].set_xlabel("field x (mm)", fontsize=7.5)
    axes[-1, 0].set_ylabel("y (mm)", fontsize=7.5)


def double_zernikes(wavefront: Wavefront, _quality: Quality | None = None) -> xr.Dataset:
    """Return the double Zernikes of a wavefront with their standard deviations."""
    return _double_zernikes(_zernikes(wavefront), wavefront.sensor, wavefront.field)


def zernikes_of_views(wavefront: Wavefront, order: ZernikeOrder = "noll") -> xr.Dataset:
    """Return the Zernike coefficients of the views, see `coefficient_maps`."""
    field = wavefront.field
    x, y = field.view_x_m / field.half_width_m, field.view_y_m / field.half_width_m
    return coefficient_maps(_zernikes(wavefront), field, x, y, order=order)


def _zernikes(wavefront: Wavefront) -> FieldCoefficients:
    try:
        return fit_coefficients(ModalFit.of(wavefront), "zernike")
    except ReconstructionError as error:
        raise InputError(f"the wavefront cannot be written in Zernike modes: {error}") from error
