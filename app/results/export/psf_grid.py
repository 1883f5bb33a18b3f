"""The point-spread function at every view, for programs that sharpen images piece by piece."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from app.results.export.imagej import write_stack
from reconstruction.arrays import Floats
from reconstruction.geometry import Field, Sensor
from reconstruction.quality.image_quality import psf, psf_angles_rad, psf_reach_rad


@dataclass(frozen=True, slots=True, eq=False)
class PsfGrid:
    """What a point at each view looks like, exposed over a number of frames, tilt included."""

    psf: Floats  # (view_row, view_column, angle_row, angle_column), each view's sum is 1; NaN where nothing is known
    angle_rad: Floats  # along x and along y, (angle,)
    light: Floats  # part of the view's light that falls on this square of angles, (view_row, view_column)


def psf_reach(views: Iterable[Floats], sensor: Sensor) -> float:
    """How far from angle 0 nearly all light of all frames arrives, rad; NaN where nothing is known.

    `views` (view_row, view_column, lenslet_row, lenslet_column), rad, of frame after frame.
    """
    return float(np.fmax.reduce([psf_reach_rad(phase, sensor) for phase in views], initial=np.nan))


def psf_grid(views: Iterable[Floats], sensor: Sensor, reach_rad: float) -> PsfGrid:
    """Mean over frames of the point-spread functions from -reach to +reach; `views` as in `psf_reach`.

    The integral over all angles is wavelength^2 over the transmitting area (Parseval), where the peak of the same pupil
    without aberration is 1: that tells how much light the square misses.
    """
    angle_rad = psf_angles_rad(sensor, reach_rad)
    solid_angle = (angle_rad[1] - angle_rad[0]) ** 2
    total, frames = np.zeros(()), np.zeros(())
    for phase in views:
        lenslets = np.isfinite(phase).sum(axis=(-2, -1))
        area_m2 = lenslets * sensor.lenslet_pitch_m**2
        # As parts of the light that the pupil transmits, so that frames with lenslets lost count as the others.
        parts = (
            psf(phase, sensor, angle_rad=angle_rad) * (area_m2 * solid_angle / sensor.wavelength_m**2)[..., None, None]
        )
        total = total + np.where(lenslets[..., None, None] > 0, parts, 0.0)
        frames = frames + (lenslets > 0)
    with np.errstate(invalid="ignore"):  # views of which no frame knows anything
        light = total.sum(axis=(-2, -1)) / frames
        return PsfGrid(total / total.sum(axis=(-2, -1), keepdims=True), angle_rad, light)


def write_psf_grid(path: Path, grid: PsfGrid, field: Field, about: dict[str, Any]) -> None:
    """Write the views of which something is known as a float32 stack, with their positions as labels and as JSON."""
    known = list(_known_views(grid))
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


def _known_views(grid: PsfGrid) -> Iterator[tuple[int, int]]:
    for row, column in np.ndindex(grid.light.shape):
        if np.isfinite(grid.light[row, column]):
            yield row, column
