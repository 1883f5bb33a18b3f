"""Warnings about settings and states in which pixels are not proportional to photons."""

from drivers.dcam import property_ids as ids
from drivers.dcam.properties import Properties
from drivers.dcam.property_ids import Id

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
    if has_em_gain:
        warnings += _of_em_gain(values)
    cooler = values.get_or(Id.SENSORCOOLERSTATUS, 0)
    if cooler < 0 or cooler == ids.COOLERSTATUS_WARNING:
        temperature = values.get(Id.SENSORTEMPERATURE)
        warnings.append(f"the sensor's cooler reports a fault at {temperature:g} degC: dark current is high")
    return tuple(warnings)


def _of_em_gain(values: Properties) -> list[str]:
    warnings = []
    if values.get_or(Id.DIRECTEMGAIN_MODE, ids.OFF) != ids.ON:
        warnings.append("the EM gain is a number on the camera's own scale, not the true multiplication")
    match values.get_or(Id.EMGAINWARNING_STATUS, 1):
        case ids.EMGAINWARNING_WARNING:
            warnings.append("too much light for this EM gain: it ages the multiplication register")
        case ids.EMGAINWARNING_PROTECTED:
            warnings.append("the camera protects its EM register from too much light: its frames are black")
    return warnings
