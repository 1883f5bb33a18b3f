"""Properties of an open DCAM camera, and the numbers of those that the driver uses."""

from collections.abc import Iterable, Iterator
from contextlib import suppress
from ctypes import byref, c_double, c_int32, create_string_buffer
from dataclasses import dataclass
from enum import IntEnum

from drivers.camera import GONE
from drivers.dcam._library import TEXT_BYTES, DcamLibrary, Denied, NotThere, PropertyAttribute, PropertyValueText, sized
from drivers.device import Property, Range
from drivers.errors import REFUSALS, BadValue, DeviceError, Disconnected


class Id(IntEnum):
    """Property numbers."""

    TRIGGERSOURCE = 0x00100110
    TRIGGERACTIVE = 0x00100120
    TRIGGER_MODE = 0x00100210
    TRIGGERPOLARITY = 0x00100220
    TRIGGERTIMES = 0x00100240
    TRIGGERDELAY = 0x00100260
    OUTPUTTRIGGER_KIND = 0x001C0160  # of the first connector
    OUTPUTTRIGGER_POLARITY = 0x001C0120
    EXPOSURETIME = 0x001F0110
    TRIGGER_GLOBALEXPOSURE = 0x001F0300
    SENSITIVITY = 0x00200220
    DIRECTEMGAIN_MODE = 0x00200250
    EMGAINWARNING_STATUS = 0x00200260
    EMGAINWARNING_LEVEL = 0x00200270
    EMGAINPROTECT_MODE = 0x00200290
    EMGAINPROTECT_AFTERFRAMES = 0x002002A0
    PHOTONIMAGINGMODE = 0x002002F0
    SENSORTEMPERATURE = 0x00200310
    SENSORCOOLER = 0x00200320
    SENSORCOOLERSTATUS = 0x00200340
    HIGHDYNAMICRANGE_MODE = 0x00300150
    REALTIMEGAINCORRECT_MODE = 0x00300170
    RECURSIVEFILTER = 0x00380110
    SPOTNOISEREDUCER = 0x00380130
    SUBTRACT = 0x00380210
    SHADINGCORRECTION = 0x00380310
    FRAMEAVERAGINGMODE = 0x003803A0
    CAPTUREMODE = 0x00380410
    INTENSITYLUT_MODE = 0x00380510
    INTENSITY_GAMMA = 0x00380560
    ADVANCEDEDGEENHANCEMENT_MODE = 0x00380630
    READOUTSPEED = 0x00400110
    SENSORMODE = 0x00400210
    CCDMODE = 0x00400310
    EMCCD_CALIBRATIONMODE = 0x00400320
    OUTPUT_INTENSITY = 0x00400410
    OUTPUTDATA_ORIENTATION = 0x00400420
    BINNING = 0x00401110
    SUBARRAYHPOS = 0x00402110
    SUBARRAYHSIZE = 0x00402120
    SUBARRAYVPOS = 0x00402130
    SUBARRAYVSIZE = 0x00402140
    SUBARRAYMODE = 0x00402150
    FRAMESTAMP_PRODUCER = 0x00410A20
    BITSPERCHANNEL = 0x00420130
    IMAGE_WIDTH = 0x00420210
    IMAGE_HEIGHT = 0x00420220
    IMAGE_PIXELTYPE = 0x00420270
    IMAGEDETECTOR_PIXELWIDTH = 0x00420810
    DEFECTCORRECT_MODE = 0x00470010
    SYSTEM_ALIVE = 0x00FF0010


SUBARRAY_POSITION = (Id.SUBARRAYVPOS, Id.SUBARRAYHPOS)  # rows before columns
SUBARRAY_SIZE = (Id.SUBARRAYVSIZE, Id.SUBARRAYHSIZE)
OFF, ON = 1, 2  # of every mode that is one or the other
CCDMODE_NORMAL, CCDMODE_EM = 1, 2
EMGAINWARNING_WARNING, EMGAINWARNING_PROTECTED = 2, 3
PIXELTYPE_MONO16 = 2
GLOBALEXPOSURE_DELAYED = 3  # rolling shutter; larger numbers expose rows unequally, or only while all are open
PRODUCER_NONE = 1
ALIVE_ONLINE = 2
COOLERSTATUS_WARNING = 5  # errors are negative
AMPLIFIERS = {CCDMODE_NORMAL: "normal", CCDMODE_EM: "em"}
TRIGGER_SOURCES = {"internal": 1, "external": 2}
TRIGGERS = {number: name for name, number in TRIGGER_SOURCES.items()}
TRIGGER_ACTIVE = {"edge": 1, "level": 2, "synchronous": 3}
POLARITIES = {"negative": 1, "positive": 2}
COOLER = {"off": 1, "on": 2, "max": 4}
OUTPUTS = {"low": 1, "exposure": 2, "programmable": 3, "trigger ready": 4, "high": 5}

# Harmless value, and the effect of any other.
FILTERS = {
    Id.RECURSIVEFILTER: (OFF, "the camera's recursive filter averages frames, which lowers their noise"),
    Id.FRAMEAVERAGINGMODE: (OFF, "the camera averages frames, which lowers their noise"),
    Id.SPOTNOISEREDUCER: (OFF, "the camera's spot noise reducer changes single pixels"),
    Id.SUBTRACT: (OFF, "the camera subtracts a stored image: the counts are no longer the sensor's"),
    Id.SHADINGCORRECTION: (OFF, "the camera's shading correction scales the pixels"),
    Id.INTENSITYLUT_MODE: (1, "the camera maps the counts by a table"),
    Id.PHOTONIMAGINGMODE: (0, "the camera's photon imaging mode changes the counts"),
    Id.CAPTUREMODE: (1, "the camera takes calibration frames, no images"),
    Id.EMCCD_CALIBRATIONMODE: (OFF, "the camera calibrates its EM gain: its frames are no images"),
    Id.SENSORMODE: (1, "the camera's sensor mode is not AREA: it may count photons, or expose line by line"),
    Id.OUTPUTDATA_ORIENTATION: (1, "the camera mirrors or flips the image: signs of wavefronts are wrong"),
    Id.OUTPUT_INTENSITY: (1, "the camera sends a test pattern"),
    Id.HIGHDYNAMICRANGE_MODE: (OFF, "the camera's high dynamic range mode changes the counts"),
    Id.REALTIMEGAINCORRECT_MODE: (OFF, "the camera's real-time gain correction scales the pixels"),
    Id.DEFECTCORRECT_MODE: (OFF, "the camera's defect correction replaces single pixels"),
    Id.INTENSITY_GAMMA: (1, "the camera's gamma bends the counts"),
    Id.ADVANCEDEDGEENHANCEMENT_MODE: (OFF, "the camera sharpens the image"),
}


# Attributes of a property: single bits, and its type.
HAS_STEP, HAS_VALUE_TEXT, AUTO_ROUNDING, READABLE = 0x40000000, 0x10000000, 0x00800000, 0x00010000
TYPE_MASK, TYPE_REAL = 0xF, 3
OPTION_NEXT = 0x01000000


@dataclass(frozen=True, slots=True)
class Limits:
    """Attributes and present limits of a property."""

    range: Range
    step: float  # 0 if none
    attribute: int
    elements: int  # property with the number of array elements; 0 for a scalar
    element_step: int


class Properties:
    """Reads and writes properties by number; DCAM passes every value as a float."""

    def __init__(self, library: DcamLibrary, handle: int) -> None:
        self.library = library
        self.handle = handle
        self._known: frozenset[int] | None = None  # all properties in the present mode
        self._remembered: dict[int, float] = {}  # values that a running camera may deny

    def forget_list(self) -> None:
        """Query the list of properties again, as needed after a change of mode."""
        self._known = None
        self._remembered.clear()

    def remember(self, identifiers: Iterable[int]) -> None:
        """Read these properties, if present, so that they stay known while the camera is running."""
        for identifier in identifiers:
            if identifier not in self._remembered and self.has(identifier):
                self._remembered[identifier] = self.get(identifier)

    def limits(self, identifier: int) -> Limits:
        """Limits in the present mode."""
        answer = sized(PropertyAttribute, iProp=identifier)
        self.library.call("dcamprop_getattr", self.handle, byref(answer))
        limits, step = Range(answer.valuemin, answer.valuemax), answer.valuestep if answer.attribute & HAS_STEP else 0.0
        return Limits(limits, step, answer.attribute, answer.iProp_NumberOfElement, answer.iPropStep_Element)

    def has(self, identifier: int) -> bool:
        """True if the camera has the property in its present mode."""
        if self._known is None:
            self._known = frozenset(self._identifiers())
        return identifier in self._known

    def get(self, identifier: int) -> float:
        """Value in force; the remembered one if the running camera denies it."""
        value = c_double()
        try:
            self.library.call("dcamprop_getvalue", self.handle, identifier, byref(value))
        except Denied:
            if identifier not in self._remembered:
                raise
            return self._remembered[identifier]
        return value.value

    def get_or(self, identifier: int, default: float) -> float:
        """Value in force, or the default if the camera lacks the property or denies it while running."""
        try:
            return self.get(identifier) if self.has(identifier) else default
        except Denied:
            return default

    def check_online(self) -> None:
        """Raise `Disconnected` if the library knows that the camera is gone."""
        if self.get_or(Id.SYSTEM_ALIVE, ALIVE_ONLINE) != ALIVE_ONLINE:
            raise Disconnected(GONE)

    def set(self, identifier: int, value: float) -> float:
        """Write a value, rounded to its step; return the one in force."""
        allowed = self.limits(identifier)
        if allowed.step > 0 and not allowed.attribute & AUTO_ROUNDING:
            steps = round((value - allowed.range.minimum) / allowed.step)
            value = min(allowed.range.minimum + steps * allowed.step, allowed.range.maximum)
        taken = c_double(value)
        try:
            self.library.call("dcamprop_setgetvalue", self.handle, identifier, byref(taken), 0)
        except BadValue as error:
            name, least, most = self.name(identifier).lower(), allowed.range.minimum, allowed.range.maximum
            raise BadValue(f"{name} = {value:g}, allowed are {least:g} ... {most:g}: {error}") from error
        self._remembered.pop(identifier, None)
        return taken.value

    def set_if_present(self, identifier: int, value: float) -> None:
        """Write a value if the camera has the property."""
        if self.has(identifier):
            self.set(identifier, value)

    def values(self, identifier: int) -> tuple[int, ...]:
        """All present values of a mode or an integer; (1,), the common default, if the camera lacks it."""
        if not self.has(identifier):
            return (1,)
        allowed = self.limits(identifier).range
        value = c_double(allowed.minimum)
        values = [round(value.value)]
        while value.value < allowed.maximum:
            try:
                self.library.call("dcamprop_queryvalue", self.handle, identifier, byref(value), OPTION_NEXT)
            except (BadValue, NotThere):  # no next one
                break
            values.append(round(value.value))
        return tuple(values)

    def name(self, identifier: int) -> str:
        """Hamamatsu's name of the property."""
        text = create_string_buffer(TEXT_BYTES)
        self.library.call("dcamprop_getname", self.handle, identifier, text, TEXT_BYTES)
        return text.value.decode(errors="replace")

    def readable(self) -> dict[str, Property]:
        """All readable properties by Hamamatsu's names, where the camera reports them; errors in place of values."""
        readable: dict[str, Property] = {}
        for identifier in self._identifiers():
            try:
                allowed, name = self.limits(identifier), self.name(identifier)
            except REFUSALS:
                continue
            if allowed.attribute & READABLE:
                try:
                    readable[name] = self._worded(identifier, allowed)
                except Disconnected:
                    raise
                except DeviceError as error:
                    readable[name] = str(error)
        return readable

    def _worded(self, identifier: int, allowed: Limits) -> Property:
        value = self.get(identifier)
        if allowed.attribute & HAS_VALUE_TEXT:
            with suppress(*REFUSALS):
                kind = PropertyValueText
                return self.library.text("dcamprop_getvaluetext", self.handle, kind, iProp=identifier, value=value)
        return value if allowed.attribute & TYPE_MASK == TYPE_REAL else round(value)

    def _identifiers(self) -> Iterator[int]:
        """All properties, with the array elements, which DCAM does not enumerate."""
        identifier = c_int32(0)
        while self._advance(identifier):
            yield identifier.value
            with suppress(*REFUSALS):
                base = self.limits(identifier.value)
                count = round(self.get(base.elements)) if base.elements else 1
                for element in range(1, count):
                    yield identifier.value + element * base.element_step

    def _advance(self, identifier: c_int32) -> bool:
        try:
            self.library.call("dcamprop_getnextid", self.handle, byref(identifier), 0)
        except NotThere:  # no next one
            return False
        return identifier.value != 0
