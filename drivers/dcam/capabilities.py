"""Capabilities and sensor region of a DCAM camera in its present mode."""

import math
from contextlib import suppress

from drivers.camera import CameraCapabilities
from drivers.dcam import property_ids as ids
from drivers.dcam.properties import Properties
from drivers.dcam.property_ids import Id
from drivers.errors import DeviceError, Unsupported
from drivers.frame import Region
from drivers.range import Range

AMPLIFIERS = {ids.CCDMODE_NORMAL: "normal", ids.CCDMODE_EM: "em"}
TRIGGERS = {number: name for name, number in ids.TRIGGER_SOURCES.items()}
_SQUARE = 100  # larger numbers are oblong: 102 is 1 x 2


def read_capabilities(values: Properties, pixel_pitch_m: float | None) -> CameraCapabilities:
    """Query the camera; `pixel_pitch_m` of the sensor overrides the camera's value."""
    whole, step_px = _sensor(values)
    speeds = values.limits(Id.READOUTSPEED).range if values.has(Id.READOUTSPEED) else Range(1, 1)
    return CameraCapabilities(
        rows=round(values.get(Id.IMAGE_HEIGHT)),
        columns=round(values.get(Id.IMAGE_WIDTH)),
        pixel_pitch_m=_pixel_pitch_m(values, pixel_pitch_m) * round(values.get_or(Id.BINNING, 1)),
        full_scale=2 ** round(values.get(Id.BITSPERCHANNEL)) - 1,
        exposure_range_s=values.limits(Id.EXPOSURETIME).range,
        em_gain_range=values.limits(Id.SENSITIVITY).range if has_em_gain(values) else Range(1.0, 1.0),
        amplifiers=tuple(AMPLIFIERS[mode] for mode in _modes(values, Id.CCDMODE) if mode in AMPLIFIERS),
        readout_speeds=tuple(range(round(speeds.minimum), round(speeds.maximum) + 1)),
        binnings=tuple(mode for mode in _modes(values, Id.BINNING) if mode < _SQUARE),
        triggers=tuple(TRIGGERS[mode] for mode in _modes(values, Id.TRIGGERSOURCE) if mode in TRIGGERS),
        sensor=whole,
        region_step_px=step_px,
    )


def has_em_gain(values: Properties) -> bool:
    """True if the amplifier in use multiplies electrons."""
    return values.get_or(Id.CCDMODE, ids.CCDMODE_NORMAL) == ids.CCDMODE_EM


def _modes(values: Properties, identifier: Id) -> tuple[int, ...]:
    """Values of a mode; (1,), the common default, if the camera lacks it."""
    return values.values(identifier) if values.has(identifier) else (1,)


def _pixel_pitch_m(values: Properties, wanted_m: float | None) -> float:
    pitch_m = wanted_m or 1e-6 * values.get_or(Id.IMAGEDETECTOR_PIXELWIDTH, 0.0)
    if not pitch_m:
        raise Unsupported("this camera does not report its pixel pitch: set camera.pixel_pitch_m")
    return pitch_m


def _sensor(values: Properties) -> tuple[Region | None, int]:
    """Return the whole sensor, None if it has no subarrays, and their step in pixels."""
    if not values.has(Id.SUBARRAYMODE):
        return None, 1
    rows, columns, top, left = (
        values.limits(identifier)
        for identifier in (Id.SUBARRAYVSIZE, Id.SUBARRAYHSIZE, Id.SUBARRAYVPOS, Id.SUBARRAYHPOS)
    )
    step_px = math.lcm(*(max(1, round(limits.step)) for limits in (rows, columns, top, left)))
    return Region(0, 0, round(rows.range.maximum), round(columns.range.maximum)), step_px


def read_region(values: Properties, whole: Region) -> Region:
    """Return the region in force."""
    if values.get(Id.SUBARRAYMODE) != ids.ON:
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
    values.set(Id.SUBARRAYMODE, ids.OFF)
    if region == whole:
        return
    for position, size, start_px, length_px in (
        (Id.SUBARRAYHPOS, Id.SUBARRAYHSIZE, region.left, region.columns),
        (Id.SUBARRAYVPOS, Id.SUBARRAYVSIZE, region.top, region.rows),
    ):
        values.set(position, 0)
        values.set(size, length_px)
        values.set(position, start_px)
    values.set(Id.SUBARRAYMODE, ids.ON)
