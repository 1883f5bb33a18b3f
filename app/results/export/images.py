"""Image stacks for ImageJ: any images as BigTIFF, and the point-spread function of every view."""

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from numpy.typing import NDArray

from app.files import atomic_write
from reconstruction.arrays import Floats
from reconstruction.geometry import Field, Sensor
from reconstruction.quality.image_quality import psf, psf_angles_rad, psf_reach_rad


def write_stack(
    path: Path,
    images: Iterable[NDArray[Any]],
    *,
    labels: Sequence[str],
    information: str,
    pixel_um: float,
    interval_s: float | None = None,
) -> None:
    """Write images (row, column) of one size and type as BigTIFF, one in memory at a time.

    tifffile's own ImageJ mode ends at 4 GB; this writes the same description and tags into a BigTIFF.

    Parameters
    ----------
    path
        The file.
    images
        As many images as `labels`.
    labels
        Text that ImageJ shows above each image.
    information
        Text under Image > Show Info.
    pixel_um
        Size of a pixel.
    interval_s
        Time between frames; with it the images are a film.
    """
    remaining = iter(images)
    first = next(remaining)
    shape = (len(labels), *first.shape)
    film: dict[str, Any] = {} if interval_s is None else {"finterval": interval_s}
    tags = tifffile.imagej_metadata_tag({"Info": information, "Labels": list(labels)}, "<")
    with atomic_write(path) as temporary, tifffile.TiffWriter(temporary, bigtiff=True, byteorder="<") as writer:
        writer.write(
            chain([first], remaining),
            shape=shape,
            dtype=first.dtype,
            photometric="minisblack",
            description=tifffile.imagej_description(shape, axes="TYX" if film else "ZYX", unit="um", **film),
            metadata=None,  # replaced by the description
            extratags=tags,
            resolution=(1 / pixel_um, 1 / pixel_um),
            resolutionunit="NONE",
        )


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
    """Return the mean point-spread functions over frames from -reach to +reach; `views` as in `psf_reach`.

    The integral over all angles is wavelength^2 / transmitting area (Parseval), with 1 as the peak of the same pupil
    without aberration; hence the part of the light within the square.
    """
    angle_rad = psf_angles_rad(sensor, reach_rad)
    solid_angle = (angle_rad[1] - angle_rad[0]) ** 2
    total, frames = np.zeros(()), np.zeros(())
    for phase in views:
        lenslets = np.isfinite(phase).sum(axis=(-2, -1))
        scale = lenslets * sensor.lenslet_pitch_m**2 * solid_angle / sensor.wavelength_m**2
        parts = psf(phase, sensor, angle_rad=angle_rad) * scale[..., None, None]  # of the transmitted light
        total = total + np.where(lenslets[..., None, None] > 0, parts, 0.0)
        frames = frames + (lenslets > 0)
    with np.errstate(invalid="ignore"):  # views that are unknown in all frames
        light = total.sum(axis=(-2, -1)) / frames
        return PsfGrid(total / total.sum(axis=(-2, -1), keepdims=True), angle_rad, light)


def write_psf_grid(path: Path, grid: PsfGrid, field: Field, about: dict[str, Any]) -> None:
    """Write the known views as a float32 stack, with their positions as labels and as JSON."""
    known = [view for view in np.ndindex(grid.light.shape) if np.isfinite(grid.light[view])]
    step_rad = float(grid.angle_rad[1] - grid.angle_rad[0])
    pixel_m = step_rad * field.collimator_focal_length_m
    places = [
        {
            "view_row": row,
            "view_column": column,
            "x_m": float(field.view_x_m[column]),
            "y_m": float(field.view_y_m[row]),
            "light": float(grid.light[row, column]),
        }
        for row, column in known
    ]
    information = {"pixel_rad": step_rad, "pixel_m": pixel_m, "views": places, **about}
    write_stack(
        path,
        (grid.psf[view].astype(np.float32) for view in known),
        labels=[f"x = {place['x_m'] * 1e3:+.3f} mm, y = {place['y_m'] * 1e3:+.3f} mm" for place in places],
        information=json.dumps(information, indent=1),
        pixel_um=pixel_m * 1e6,
    )
