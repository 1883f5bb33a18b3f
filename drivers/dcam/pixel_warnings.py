"""In which settings and states a camera's pixels are not proportional to photons, in words."""

from __future__ import annotations

from drivers.dcam import property_ids as ids
from drivers.dcam.properties import Properties
from drivers.dcam.property_ids import Id

# The value at which it does nothing, and what it does otherwise.
_FILTERS = {
    Id.RECURSIVEFILTER: (
        ids.OFF,
        "the camera's recursive filter averages frames: their noise is not that of one frame",
    ),
    Id.FRAMEAVERAGINGMODE: (ids.OFF, "the camera averages frames: their noise is not that of one frame"),
    Id.SPOTNOISEREDUCER: (ids.OFF, "the camera's spot noise reducer changes single pixels"),
    Id.SUBTRACT: (ids.OFF, "the camera subtracts a stored image: the counts are no longer those of the sensor"),
    Id.SHADINGCORRECTION: (ids.OFF, "the camera's shading correction scales the pixels"),
    Id.INTENSITYLUT_MODE: (1, "the camera maps the counts by a table"),
    Id.PHOTONIMAGINGMODE: (0, "the camera's photon imaging mode changes the counts"),
    Id.CAPTUREMODE: (1, "the camera takes calibration frames, no images"),
}


def pixel_warnings(values: Properties, *, has_em_gain: bool) -> tuple[str, ...]:
    """Ask the camera for everything that a person should know before trusting its pixels; nothing is the rule."""
    found = [
        sentence
        for identifier, (harmless, sentence) in _FILTERS.items()
        if values.get_or(identifier, harmless) != harmless
    ]
    triggered = values.get_or(Id.TRIGGERSOURCE, 1) == ids.TRIGGER_SOURCES["external"]
    if triggered and values.get_or(Id.TRIGGERACTIVE, 1) != ids.TRIGGER_ACTIVE["edge"]:
        found.append("the trigger's pulses make the exposure, not the time that is set")
    if has_em_gain:
        found += _of_em_gain(values)
    cooler = values.get_or(Id.SENSORCOOLERSTATUS, 0)
    if cooler < 0 or cooler == ids.COOLERSTATUS_WARNING:
        temperature = values.get(Id.SENSORTEMPERATURE)
        found.append(f"the sensor's cooler is in trouble at {temperature:g} degC: dark current is high")
    return tuple(found)


def _of_em_gain(values: Properties) -> list[str]:
    found = []
    if values.get_or(Id.DIRECTEMGAIN_MODE, ids.OFF) != ids.ON:
        found.append("the EM gain is a number on the camera's own scale, not the true multiplication")
    match values.get_or(Id.EMGAINWARNING_STATUS, 1):
        case ids.EMGAINWARNING_WARNING:
            found.append("too much light for this EM gain: it ages the multiplication register")
        case ids.EMGAINWARNING_PROTECTED:
            found.append("the camera protects its EM register from too much light: its frames are black")
    return found
