"""Point-spread functions: at a field position, in results, as means over a recording's frames."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from app.images import write_stack
from app.results.result_file import VIEW, Variable, about
from app.results.sources import measured
from reconstruction.arrays import Floats
from reconstruction.geometry import Field, Sensor
from reconstruction.quality import image_quality
from reconstruction.quality.image_quality import diffraction_rad, psf_angles_rad, psf_reach_rad
from reconstruction.wavefront import Wavefront

if TYPE_CHECKING:
    import xarray as xr

_PSF_REACH = 16  # half width of the map in diffraction widths (wavelength / pupil width), equal for all frames


def psf(wavefront: Wavefront, x_m: float, y_m: float) -> xr.DataArray:
    """Point-spread function at one position of the field.

    Parameters
    ----------
    wavefront
        A reconstructed wavefront.
    x_m, y_m
        Field position, m.

    Returns
    -------
    xarray.DataArray
        Intensity (angle_y, angle_x) over the peak of the unaberrated pupil, so 1 is diffraction-limited and the value
        at angle 0 is the Strehl ratio; the coordinates are field angles in rad.

    Raises
    ------
    ValueError
        If the position lies outside the field.

    Examples
    --------
    >>> image = svwfs.psf(wavefront, x_m=0.0, y_m=0.5e-3)
    >>> image.dims
    ('angle_y', 'angle_x')
    """
    import xarray as xr

    phase, sensor = measured(wavefront).at(x_m, y_m), wavefront.sensor
    angle_rad = psf_angles_rad(sensor, psf_reach_rad(phase, sensor))
    values = image_quality.psf(phase, sensor, angle_rad=angle_rad)
    angles = {name: (name, angle_rad, {"units": "rad"}) for name in ("angle_y", "angle_x")}
    return xr.DataArray(values, dims=("angle_y", "angle_x"), coords=angles, name="psf")


def point_spread(wavefront: Wavefront) -> dict[str, Variable]:
    """Point-spread function of every view on a fixed grid of angles."""
    sensor = wavefront.sensor
    angle_rad = psf_angles_rad(sensor, _PSF_REACH * diffraction_rad(sensor))
    ideal = about("1", "point-spread function over its peak when unaberrated")
    values = image_quality.psf(wavefront.views, sensor, angle_rad=angle_rad).astype(np.float32)
    return {
        "psf": ((*VIEW, "angle_y", "angle_x"), values, ideal),
        "angle_x": (("angle_x",), angle_rad, about("rad", "field angle along x")),
        "angle_y": (("angle_y",), angle_rad, about("rad", "field angle along y")),
    }


@dataclass(frozen=True, slots=True, eq=False)
class PsfGrid:
    """Point-spread function of each view, averaged over frames, tilt included."""

    psf: Floats  # (view_row, view_column, angle_row, angle_column), sum 1 for each view; NaN where unknown
    angle_rad: Floats  # along x and along y, (angle,)
    light: Floats  # part of the view's light within these angles, (view_row, view_column)


def psf_reach(views: Iterable[Floats], sensor: Sensor) -> float:
    """Return the angle within which nearly all light of all frames arrives, rad; NaN if unknown.

    `views` yields the wavefront of each frame, rad, (view_row, view_column, lenslet_row, lenslet_column).
    """
    return float(np.fmax.reduce([psf_reach_rad(phase, sensor) for phase in views], initial=np.nan))


def psf_grid(views: Iterable[Floats], sensor: Sensor, reach_rad: float) -> PsfGrid:
    """Return the mean point-spread functions of frames from -reach to +reach; `views` as in `psf_reach`.

    The integral over all angles is wavelength^2 / transmitting area (Parseval), with 1 as the peak of the same pupil
    without aberration; hence the part of the light within the square.
    """
    angle_rad = psf_angles_rad(sensor, reach_rad)
    solid_angle = (angle_rad[1] - angle_rad[0]) ** 2
    total, frames = np.zeros(()), np.zeros(())
    for phase in views:
        lenslets = np.isfinite(phase).sum(axis=(-2, -1))
        scale = lenslets * sensor.lenslet_pitch_m**2 * solid_angle / sensor.wavelength_m**2
        parts = image_quality.psf(phase, sensor, angle_rad=angle_rad) * scale[..., None, None]  # of the light
        total = total + np.where(lenslets[..., None, None] > 0, parts, 0.0)
        frames = frames + (lenslets > 0)
    with np.errstate(invalid="ignore"):  # views that are unknown in all frames
        light = total.sum(axis=(-2, -1)) / frames
        return PsfGrid(total / total.sum(axis=(-2, -1), keepdims=True), angle_rad, light)


def write_psf_grid(path: Path, grid: PsfGrid, field: Field, facts: dict[str, Any]) -> None:
    """Write the known views as a float32 stack, with their positions as labels and as JSON."""
    known = [view for view in np.ndindex(grid.light.shape) if np.isfinite(grid.light[view])]
    step_rad = float(grid.angle_rad[1] - grid.angle_rad[0])
    pixel_m = step_rad * field.collimator_focal_length_m
    places = [
        {"view_row": row, "view_column": column, "x_m": x_m, "y_m": y_m, "light": float(grid.light[row, column])}
        for row, column in known
        for x_m, y_m in [(float(field.view_x_m[column]), float(field.view_y_m[row]))]
    ]
    information = {"pixel_rad": step_rad, "pixel_m": pixel_m, "views": places, **facts}
    write_stack(
        path,
        (grid.psf[view].astype(np.float32) for view in known),
        labels=[f"x = {place['x_m'] * 1e3:+.3f} mm, y = {place['y_m'] * 1e3:+.3f} mm" for place in places],
        information=json.dumps(information, indent=1),
        pixel_um=pixel_m * 1e6,
    )
