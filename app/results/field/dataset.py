"""Coefficients over the field as a dataset (docs/field.md)."""

import numpy as np
import xarray as xr

from app.errors import InputError
from app.results.mode_coefficients import mode_names
from app.results.view_quality import Variable, about
from reconstruction.field_coefficients import FieldCoefficients
from reconstruction.geometry import Field, Sensor


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
