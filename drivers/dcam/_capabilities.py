"""Capabilities and sensor region of a DCAM camera in its present mode; warnings of false counts."""

import math
from contextlib import suppress

from drivers.camera import CameraCapabilities, Region
from drivers.dcam import _property_ids as ids
from drivers.dcam._properties import Properties
from drivers.dcam._property_ids import Id
from drivers.device import Range
from drivers.errors import DeviceError, Unsupported

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


# Harmless value, and the effect of any other.
FILTERS = {
    Id.RECURSIVEFILTER: (ids.OFF, "the camera's recursive filter averages frames, which lowers their noise"),
    Id.FRAMEAVERAGINGMODE: (ids.OFF, "the camera averages frames, which lowers their noise"),
    Id.SPOTNOISEREDUCER: (ids.OFF, "the camera's spot noise reducer changes single pixels"),
    Id.SUBTRACT: (ids.OFF, "the camera subtracts a stored image: the counts are no longer those of the sensor"),
    Id.SHADINGCORRECTION: (ids.OFF, "the camera's shading correction scales the pixels"),
    Id.INTENSITYLUT_MODE: (1, "the camera maps the counts by a table"),
    Id.PHOTONIMAGINGMODE: (0, "the camera's photon imaging mode changes the counts"),
    Id.CAPTUREMODE: (1, "the camera takes calibration frames, no images"),
    Id.EMCCD_CALIBRATIONMODE: (ids.OFF, "the camera calibrates its EM gain: its frames are no images"),
    Id.SENSORMODE: (1, "the camera's sensor mode is not AREA: it may count photons, or expose line by line"),
    Id.OUTPUTDATA_ORIENTATION: (1, "the camera mirrors or flips the image: signs of wavefronts are wrong"),
    Id.OUTPUT_INTENSITY: (1, "the camera sends a test pattern"),
    Id.HIGHDYNAMICRANGE_MODE: (ids.OFF, "the camera's high dynamic range mode changes the counts"),
    Id.REALTIMEGAINCORRECT_MODE: (ids.OFF, "the camera's real-time gain correction scales the pixels"),
    Id.DEFECTCORRECT_MODE: (ids.OFF, "the camera's defect correction replaces single pixels"),
    Id.INTENSITY_GAMMA: (1, "the camera's gamma bends the counts"),
    Id.ADVANCEDEDGEENHANCEMENT_MODE: (ids.OFF, "the camera sharpens the image"),
}


def pixel_warnings(values: Properties, *, has_em_gain: bool) -> tuple[str, ...]:
    """Query the camera and return the warnings, normally none."""
    warnings = [
        sentence
        for identifier, (harmless, sentence) in FILTERS.items()
        if values.get_or(identifier, harmless) != harmless
    ]
    triggered = values.get_or(Id.TRIGGERSOURCE, 1) == ids.TRIGGER_SOURCES["external"]
    if triggered and values.get_or(Id.TRIGGERACTIVE, 1) != ids.TRIGGER_ACTIVE["edge"]:
        warnings.append("the trigger pulses determine the exposure, not the set time")
    if has_em_gain and values.get_or(Id.DIRECTEMGAIN_MODE, ids.OFF) != ids.ON:
        warnings.append("the EM gain is a number on the camera's own scale, not the true multiplication")
    match values.get_or(Id.EMGAINWARNING_STATUS, 1) if has_em_gain else 1:
        case ids.EMGAINWARNING_WARNING:
            warnings.append("too much light for this EM gain: it ages the multiplication register")
        case ids.EMGAINWARNING_PROTECTED:
            warnings.append("the camera protects its EM register from too much light: its frames are black")
    cooler = values.get_or(Id.SENSORCOOLERSTATUS, 0)
    if cooler < 0 or cooler == ids.COOLERSTATUS_WARNING:
        temperature = values.get(Id.SENSORTEMPERATURE)
        warnings.append(f"the sensor's cooler reports a fault at {temperature:g} degC: dark current is high")
    return tuple(warnings)
