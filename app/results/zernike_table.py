"""Tables of Zernike coefficients that people compare: number, name, and value in rad, nm and waves."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from app.errors import InputError
from app.files import write_csv
from app.results.result_file import VIEW, Variable, about
from app.results.shown_wavefront import REMOVABLE, Unit
from reconstruction.geometry import Sensor
from reconstruction.wavefront import peak_to_valley, rms

if TYPE_CHECKING:
    import xarray as xr

    from reconstruction.arrays import Floats

_UNITS = (Unit.RAD, Unit.NM, Unit.WAVES)
_PRINTED = 15  # modes; their highest number in each order is 14, 15 or 16
_NAMED = 11  # the last mode with a name of one word, by Noll's number
_MODE = "zernike_mode"  # dimension


def modes_named(names: str | None) -> frozenset[int]:
    """Return the Zernike modes of names such as "tilt,defocus", by Noll's numbers; `InputError` names all."""
    known: dict[str, set[int]] = {}
    for number in range(2, _NAMED + 1):
        known.setdefault(REMOVABLE[number].split()[1], set()).add(number)
    given = [name.strip().lower() for name in names.split(",")] if names else []
    for name in given:
        if name not in known:
            raise InputError(f"--remove {names}: {name or 'an empty name'} is none of {', '.join(known)}")
    return frozenset(number for name in given for number in known[name])


def in_units(rad: float, sensor: Sensor) -> str:
    """Write a phase in rad, nm and waves."""
    return " = ".join(f"{rad * unit.per_rad(sensor.wavelength_m):.4g} {unit}" for unit in _UNITS)


def view_sentence(view: Floats, sensor: Sensor) -> str:
    """Say RMS and PV of the wavefront of a view, rad, (lenslet_row, lenslet_column), in all units."""
    return f"RMS {in_units(float(rms(view)), sensor)}; PV {in_units(float(peak_to_valley(view)), sensor)}"


def printed_rows(maps: xr.Dataset, view: tuple[int, int], sensor: Sensor) -> Iterator[tuple[str, ...]]:
    """Yield number and name, nm with error, and waves of the first modes of a view, of `zernikes_of_views`."""
    of_view = maps.isel(y=view[0], x=view[1])
    nm, waves = (unit.per_rad(sensor.wavelength_m) for unit in (Unit.NM, Unit.WAVES))
    names, values, errors = (of_view[name].values for name in ("name", "coefficient", "coefficient_sigma"))
    for number, name, rad, sigma in zip(of_view["mode"].values, names, values, errors, strict=True):
        if number <= _PRINTED:
            error = f"{sigma * nm:.2g}" if np.isfinite(sigma) else "unknown"
            yield str(name), f"{rad * nm:+.2f}", error, f"{rad * waves:+.5f}"


def write_table(path: Path, maps: xr.Dataset, sensor: Sensor) -> None:
    """Write the coefficients of all views, of `zernikes_of_views`, as CSV (atomic)."""
    names = [name.split(" ", 1)[1] for name in maps["name"].values]
    factors = [unit.per_rad(sensor.wavelength_m) for unit in _UNITS]
    values, errors = maps["coefficient"].values, maps["coefficient_sigma"].values
    rows = (
        (x_m, y_m, number, name, *(values[mode, row, column] * factor for factor in factors), errors[mode, row, column])
        for row, y_m in enumerate(maps["y"].values.tolist())
        for column, x_m in enumerate(maps["x"].values.tolist())
        for mode, (number, name) in enumerate(zip(maps["mode"].values.tolist(), names, strict=True))
        if np.isfinite(values[mode, row, column])
    )
    write_csv(path, ["view_x_m", "view_y_m", "number", "name", *_UNITS, "sigma_rad"], rows)


def with_table(results: xr.Dataset, maps: xr.Dataset, sensor: Sensor) -> xr.Dataset:
    """Return results with the coefficients of the views, of `zernikes_of_views`; RMS and PV in all units."""
    of_views, note = maps.transpose("y", "x", "mode"), f"{maps.attrs['order']}; {sensor.circle.in_words}"
    rad, dimensions = of_views["coefficient"].values, (*VIEW, _MODE)
    more: dict[str, Variable] = {}
    for unit in _UNITS:
        factor, suffix = unit.per_rad(sensor.wavelength_m), "" if unit is Unit.RAD else f"_{unit}"
        more[f"zernike{suffix}"] = dimensions, rad * factor, about(unit.value, f"Zernike coefficients: {note}")
        for name in ("rms", "pv") if suffix else ():
            text = f"{name.upper()} of each view's wavefront"
            more[name + suffix] = VIEW, results[name].values * factor, about(unit.value, text)
    sigma = about("rad", "standard deviation of zernike; NaN if unknown")
    more["zernike_sigma"] = dimensions, of_views["coefficient_sigma"].values, sigma
    more["zernike_number"] = (_MODE,), maps["mode"].values, about("1", str(maps.attrs["order"]))
    more["zernike_name"] = (_MODE,), maps["name"].values.astype(object), {}
    return results.assign(more)
