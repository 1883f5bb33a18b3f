"""Sensor region of a DCAM camera (its subarray properties)."""

from __future__ import annotations

from contextlib import suppress

from drivers.dcam.properties import Properties
from drivers.dcam.property_ids import OFF, ON, Id
from drivers.errors import DeviceError
from drivers.frame import Region


def sensor(values: Properties) -> tuple[Region | None, int]:
    """Return the whole sensor, None if it has no subarrays, and their step in pixels."""
    if not values.has(Id.SUBARRAYMODE):
        return None, 1
    rows, columns, top, left = (
        values.limits(identifier)
        for identifier in (Id.SUBARRAYVSIZE, Id.SUBARRAYHSIZE, Id.SUBARRAYVPOS, Id.SUBARRAYHPOS)
    )
    step_px = round(max(1, rows.step, columns.step, top.step, left.step))
    return Region(0, 0, round(rows.range.maximum), round(columns.range.maximum)), step_px


def read_region(values: Properties, whole: Region) -> Region:
    """Return the region in force."""
    if values.get(Id.SUBARRAYMODE) != ON:
        return whole
    top, left, rows, columns = (
        round(values.get(identifier))
        for identifier in (Id.SUBARRAYVPOS, Id.SUBARRAYHPOS, Id.SUBARRAYVSIZE, Id.SUBARRAYHSIZE)
    )
    return Region(top, left, rows, columns)


def set_region(values: Properties, region: Region, whole: Region) -> Region:
    """Change the region and return the one in force; a failure restores the former one."""
    before = read_region(values, whole)
    try:
        _write_region(values, region, whole)
        return read_region(values, whole)
    except DeviceError:
        with suppress(DeviceError):
            _write_region(values, before, whole)
        raise


def _write_region(values: Properties, region: Region, whole: Region) -> None:
    """Write position 0, size, position, so that the region lies on the sensor at every step."""
    values.set(Id.SUBARRAYMODE, OFF)
    if region == whole:
        return
    for position, size, start_px, length_px in (
        (Id.SUBARRAYHPOS, Id.SUBARRAYHSIZE, region.left, region.columns),
        (Id.SUBARRAYVPOS, Id.SUBARRAYVSIZE, region.top, region.rows),
    ):
        values.set(position, 0)
        values.set(size, length_px)
        values.set(position, start_px)
    values.set(Id.SUBARRAYMODE, ON)
