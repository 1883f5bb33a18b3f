"""Sensor area (region of interest and binning), and the lattice's position in its frame.

Regions are always in unbinned pixels of the sensor.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from app.bench.config import Bench, with_known
from drivers.interface import BadValue, Camera, DeviceError, Disconnected, Region
from reconstruction.arrays import Floats
from reconstruction.geometry import Lattice, Sensor, lenslet_centers

_AROUND = 0.5  # margin around the lattice, in pitches


@dataclass(frozen=True, slots=True)
class SensorArea:
    """Region of the sensor, and binning, that make the frame."""

    region: Region
    binning: int

    def __str__(self) -> str:
        region = self.region
        where = f"{region.rows} x {region.columns} pixels from row {region.top}, column {region.left}"
        return where if self.binning == 1 else f"{where}, {self.binning} x {self.binning} binned"

    @classmethod
    def of(cls, camera: Camera) -> SensorArea:
        """Query the camera."""
        return cls(camera.region, camera.binning)


def set_area(camera: Camera, area: SensorArea) -> SensorArea:
    """Set a stopped camera's area, enlarged to whole steps, and return it as accepted; if refused, restore the last."""
    before = SensorArea.of(camera)
    try:
        _write(camera, area)
    except Disconnected:
        raise
    except DeviceError:
        _write(camera, before)
        raise
    return SensorArea.of(camera)


def in_steps(region: Region, sensor: Region, step_px: int) -> Region:
    """Return the smallest region in whole steps that contains the part of `region` on the sensor."""
    bottom, right = region.top + region.rows, region.left + region.columns
    if region.top <= 0 and region.left <= 0 and bottom >= sensor.rows and right >= sensor.columns:
        return sensor  # also if it is not a whole number of steps
    top, rows = _side_in_steps(region.top, region.rows, sensor.rows, step_px)
    left, columns = _side_in_steps(region.left, region.columns, sensor.columns, step_px)
    return Region(top, left, rows, columns)


def moved_bench(bench: Bench, before: SensorArea, after: SensorArea, sensor: Region | None) -> Bench:
    """Convert a bench to another area of the whole `sensor`, None if there is one; `BadValue` with too few pixels."""
    finer, region = before.binning / after.binning, after.region
    settings = {
        "binning": after.binning,
        "region": None if region == sensor else region,
        "rows": region.rows,  # a simulated camera becomes smaller
        "columns": region.columns,
    }
    try:
        return replace(
            bench,
            sensor=replace(bench.sensor, pixel_pitch_m=bench.sensor.pixel_pitch_m / finer),
            lattice=None if bench.lattice is None else moved_lattice(bench.lattice, before, after),
            camera=with_known(bench.camera, settings),
        )
    except ValueError as error:
        raise _too_few(after, error) from error


def moved_lattice(lattice: Lattice, before: SensorArea, after: SensorArea) -> Lattice:
    """Convert a lattice to the frame of another area."""
    finer = before.binning / after.binning

    def along(center_px: float, start_px: int, other_start_px: int) -> float:
        return (start_px - other_start_px) / after.binning + (center_px + 0.5) * finer - 0.5

    try:
        return replace(
            lattice,
            center_x_px=along(lattice.center_x_px, before.region.left, after.region.left),
            center_y_px=along(lattice.center_y_px, before.region.top, after.region.top),
            pitch_px=lattice.pitch_px * finer,
        )
    except ValueError as error:
        raise _too_few(after, error) from error


def region_around(lattice: Lattice, sensor: Sensor, area: SensorArea) -> Region:
    """Return the region of a lattice, given within `area`, with half a pitch around; it may exceed the sensor."""
    whole = moved_lattice(lattice, area, SensorArea(Region(0, 0, 0, 0), 1))
    corners = _cell_corners_px(whole, sensor).reshape(-1, 2)
    margin_px = _AROUND * whole.pitch_px
    left, top = (int(low) for low in np.floor(corners.min(axis=0) - margin_px + 0.5))
    right, bottom = (int(high) for high in np.ceil(corners.max(axis=0) + margin_px + 0.5))
    return Region(top, left, bottom - top, right - left)


def lenslets_outside(lattice: Lattice, sensor: Sensor, area: SensorArea) -> int:
    """Count the lenslets whose cells are not completely in the frame."""
    corners = _cell_corners_px(lattice, sensor)
    size = np.array([area.region.columns, area.region.rows]) // area.binning
    return int(np.any((corners < -0.5) | (corners > size - 0.5), axis=(-2, -1)).sum())


def _cell_corners_px(lattice: Lattice, sensor: Sensor) -> Floats:
    """Corners of all cells on the camera, (lenslet_row, lenslet_column, corner, xy)."""
    centers = lenslet_centers(sensor.arrangement, *sensor.lenslets)
    return lattice.camera_px(centers[..., None, :] + lattice.cell_corners)


def _side_in_steps(start_px: int, length_px: int, whole_px: int, step_px: int) -> tuple[int, int]:
    """Start and length of one side of a region, in whole steps."""
    most_px = whole_px - whole_px % step_px
    start = min(max(start_px, 0) // step_px * step_px, most_px - step_px)
    end = min(-(-(start_px + length_px) // step_px) * step_px, most_px)
    return start, max(end - start, step_px)


def _too_few(area: SensorArea, error: ValueError) -> BadValue:
    return BadValue(f"{area} are too few: {error}")


def _write(camera: Camera, area: SensorArea) -> None:
    allowed = camera.capabilities
    if area.binning != camera.binning:
        if allowed.sensor is not None:
            camera.set_region(allowed.sensor)  # a region need not fit the steps of two binnings
        camera.set_binning(area.binning)
        allowed = camera.capabilities
    if allowed.sensor is not None:
        camera.set_region(in_steps(area.region, allowed.sensor, allowed.region_step_px))
