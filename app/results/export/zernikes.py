"""Zernike coefficients of the frames of a recording: double Zernikes, and a table of the views."""

from collections.abc import Iterator

import xarray as xr

from app.errors import SETTINGS_CHANGED, InputError
from app.results.field.dataset import circles, double_zernike_variables
from app.results.field.table import table_names, table_rows
from reconstruction.errors import ReconstructionError
from reconstruction.field_coefficients import FieldCoefficients, ModalFit, field_coefficients
from reconstruction.quality.verdict import Quality
from reconstruction.wavefront import Wavefront


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
