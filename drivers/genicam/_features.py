"""Features of a GenICam camera: resets, digitiser, exposure, trigger, binning, region."""

import math
import re
from typing import Final

from drivers.camera import INTERNAL, Region
from drivers.device import Range
from drivers.errors import BadValue, Unsupported, attempt
from drivers.genicam._connection import GenicamConnection

# In this order: the exposure mode, for example, may lock the automatic exposure. The first value that fits is set.
_OFF: Final[tuple[str, ...]] = ("false", "Off", "Disabled", "ContrastMode_Off")
_ONE: Final = ("1", "X1", "Off")
FRAME_RATE: Final = dict.fromkeys(("AcquisitionFrameRateEnable", "AcquisitionFrameRateEnabled"), _OFF)  # cap exposures
# Switches, some of them selections, that change counts, mix frames or cycle exposures: all names that the public
# descriptions of 88 cameras have for them.
_SWITCHES: Final = (
    *("GammaEnable", "GammaEnabled", "SequencerMode", "SequencerEnable"),
    *("TestPattern", "TestPatternEnable", "TestImageSelector", "BlackLevelAuto", "pgrExposureCompensationAuto"),
    *("DefectCorrectStaticEnable", "DefectCorrectionEnable", "DefectCorrectionMode", "DefectPixelCorrectionEnable"),
    *("DefectMaskEnable", "DefectMaskColumnEnable", "DefectMaskPixelEnable", "VendorDefectPixelCorr", "CorrectionMode"),
    *("pgrDefectPixelCorrectionEnable", "BslDefectPixelCorrectionMode", "BslStaticDefectPixelCorrectionMode"),
    *("SharpnessEnabled", "SharpnessAuto", "SharpeningAuto", "SharpeningEnable", "EdgeFilter", "MedianFilter"),
    *("NoiseReductionEnable", "DenoisingEnable", "ContrastEnable", "ContrastAuto", "ContrastMode"),
    *("HDREnable", "HDRMode", "HDR_Mode", "pgrHDRModeEnabled", "VignettingCorrectionMode", "LensShadingCorrectionMode"),
)
RESETS: Final[dict[str, tuple[str, ...]]] = {
    "AcquisitionMode": ("Continuous",),
    "ExposureMode": ("Timed",),
    "ExposureAuto": _OFF,
    "GainAuto": _OFF,
    **FRAME_RATE,
    "Gamma": ("1",),  # before it is disabled, which may lock it
    **dict.fromkeys(_SWITCHES, _OFF),
    **dict.fromkeys(("SharpnessEnhancement", "SharpnessEnhancementAbs", "BslSharpnessEnhancement"), ("1",)),
    "Sharpness": ("0",),
    **dict.fromkeys(("NoiseReduction", "NoiseReductionAbs", "BslNoiseReduction"), ("0", "Off")),
    "BslContrastMode": ("Linear",),
    "BslContrast": ("0",),
    "DigitalShift": ("0",),
    "ImageCompressionMode": _OFF,  # its frames would be too short
    "IspEnable": _OFF,  # after what it contains
    "LUTEnable": _OFF,
    **dict.fromkeys(("DecimationVertical", "DecimationHorizontal", "BinningVertical", "BinningHorizontal"), _ONE),
    **dict.fromkeys(("ReverseX", "ReverseY", "ChunkModeActive", "GevSCPSBigEndian", "pgrPixelBigEndian"), _OFF),
}


def reset(connection: GenicamConnection, features: dict[str, tuple[str, ...]]) -> None:
    """Reset features where they are writable; what the camera refuses stays, and shows in its properties."""
    for feature, values in features.items():
        before = connection.optional_text(feature)
        if before is None or before in values or not connection.is_writable(feature):
            continue
        choices = attempt(connection.choices, feature)  # None if it is no enumeration
        fitting = [value for value in values if choices is None or value in choices]
        if fitting:
            attempt(connection.set_text, feature, fitting[0])


DIGITISERS: Final = ("AdcBitDepth", "SensorBitDepth", "BslSensorBitDepth", "SensorBits")  # "Bit12", "Bpp12" or "12"


def set_digitiser(connection: GenicamConnection, wanted_bits: int) -> int | None:
    """Set the digitiser to the smallest depth that suffices; return the depth, if it is reported.

    A leftover depth of 8 bits would leave the others of a deeper pixel format empty.
    """
    for feature in DIGITISERS:
        choices = attempt(connection.choices, feature) or ()
        depths = {bits: choice for choice in choices if (bits := trailing_number(choice))}
        if depths and connection.is_writable(feature):
            best = depths[min((bits for bits in depths if bits >= wanted_bits), default=max(depths))]
            if connection.optional_text(feature) != best:
                attempt(connection.set_text, feature, best)
        if bits := trailing_number(connection.optional_text(feature) or ""):
            return bits
    return None


def trailing_number(text: str) -> int:
    """Return the number at the end of a text; 0 if there is none."""
    found = re.search(r"\d+$", text)
    return int(found.group()) if found else 0


_IN_MICROSECONDS: Final = ("ExposureTime", "ExposureTimeAbs")


class ExposureTime:
    """Exposure time through Aravis, or through an integer feature, which Aravis refuses."""

    def __init__(self, connection: GenicamConnection) -> None:
        self._connection = connection
        self._integer = ""
        if attempt(connection.outputs, "arv_camera_get_exposure_time_bounds") is None:
            self._integer = next(filter(connection.has, _IN_MICROSECONDS), "")
            if not self._integer:
                raise Unsupported(f"the camera offers no exposure time: neither {' nor '.join(_IN_MICROSECONDS)}")

    def range_s(self) -> Range:
        """Return the allowed exposures."""
        if self._integer:
            shortest_us, longest_us, _ = map(float, self._connection.integer_bounds(self._integer))
        else:
            shortest_us, longest_us = self._connection.outputs("arv_camera_get_exposure_time_bounds")
        return Range(shortest_us / 1e6, longest_us / 1e6)

    def read_s(self) -> float:
        """Return the exposure in force."""
        if self._integer:
            return self._connection.integer(self._integer) / 1e6
        return float(self._connection.call("arv_camera_get_exposure_time")) / 1e6

    def set_s(self, exposure_s: float) -> None:
        """Change the exposure."""
        allowed = self.range_s()
        exposure_us = min(max(round(exposure_s * 1e6, 3), allowed.minimum * 1e6), allowed.maximum * 1e6)
        if self._integer:
            self._connection.set_text(self._integer, str(round(exposure_us)))
        else:
            self._connection.call("arv_camera_set_exposure_time", exposure_us)


_OF_FRAMES: Final = ("FrameStart", "FrameBurstStart", "AcquisitionStart", "ExposureStart")  # the first offered is used


def sources(connection: GenicamConnection) -> tuple[str, ...]:
    """Return what can start an exposure."""
    return (INTERNAL, *(source for source in connection.choices("TriggerSource") if source != "Software"))


def trigger(connection: GenicamConnection) -> str:
    """Return what starts an exposure now."""
    return connection.text("TriggerSource") if connection.optional_text("TriggerMode") == "On" else INTERNAL


def set_trigger(connection: GenicamConnection, source: str) -> None:
    """Switch off all triggers, and on the one of frames unless they start by themselves.

    Aravis has such a function, too, but that fails if `TriggerSelector` is read-only, as on older Blackfly and Flea3.
    """
    selectors = connection.choices("TriggerSelector") if connection.is_writable("TriggerSelector") else ()
    for selector in selectors:
        connection.set_text("TriggerSelector", selector)
        _switch(connection, "Off")
    if not selectors:
        _switch(connection, "Off")
    if source == INTERNAL:
        return
    if selectors:
        if not (fitting := [selector for selector in _OF_FRAMES if selector in selectors]):
            raise Unsupported(f"the camera has no trigger for frames, only for {', '.join(selectors)}")
        connection.set_text("TriggerSelector", fitting[0])
    connection.set_text("TriggerSource", source)  # some lock it once the trigger is on
    if "RisingEdge" in connection.choices("TriggerActivation"):
        connection.set_text("TriggerActivation", "RisingEdge")
    _switch(connection, "On")


def _switch(connection: GenicamConnection, mode: str) -> None:
    if connection.optional_text("TriggerMode") not in {None, mode}:
        connection.set_text("TriggerMode", mode)


_LARGEST_BINNING: Final = 64
_AXES: Final = ("BinningVertical", "BinningHorizontal")  # in this order: on some, the horizontal one only follows


class Geometry:
    """Binning and region, in pixels of the sensor, through features that may be missing, locked, or enumerations."""

    def __init__(self, connection: GenicamConnection) -> None:
        self._connection = connection
        axes = [axis for axis in _AXES if connection.has(axis)]
        is_complete = len(axes) == len(_AXES)
        self._free = [axis for axis in axes if is_complete and connection.is_writable(axis) and self._values(axis)]
        self.has_offsets = connection.has("OffsetX") and connection.has("OffsetY")

    def binning(self) -> int:
        """Return the binning in force."""
        down, across = (trailing_number(self._connection.optional_text(axis) or "") or 1 for axis in _AXES)
        if down != across:
            raise Unsupported(f"the camera bins {down} rows and {across} columns: square pixels are needed")
        return down

    def binnings(self) -> tuple[int, ...]:
        """Return the binnings available on both axes; an axis that cannot be set follows the other one."""
        if not self._free:
            return (self.binning(),)
        common = set.intersection(*(set(self._values(axis)) for axis in self._free))
        return tuple(sorted(common)) or (self.binning(),)

    def set_binning(self, binning: int) -> None:
        """Change the binning of both axes; the camera may change its region."""
        for axis in self._free:
            self._connection.set_text(axis, self._values(axis)[binning])
        if (taken := self.binning()) != binning:
            raise Unsupported(f"the camera set a binning of {taken} instead of {binning}")

    def sensor(self) -> Region:
        """Return the largest region that can be read out with the present binning."""
        binning = self.binning()
        sides = (("Height", "HeightMax", "SensorHeight"), ("Width", "WidthMax", "SensorWidth"))
        rows, columns = (self._length(*side, binning) for side in sides)
        return Region(0, 0, rows, columns)

    def region_step_px(self) -> int:
        """Return the common step of all sides of a region."""
        return math.lcm(*(self._step(side) for side in ("OffsetX", "OffsetY", "Width", "Height"))) * self.binning()

    def region(self) -> Region:
        """Return the region in force."""
        binning = self.binning()
        left, top, columns, rows = (number * binning for number in self._connection.region())
        return Region(top, left, rows, columns)

    def set_region(self, region: Region) -> None:
        """Change the region."""
        binning = self.binning()
        rows, columns = region.rows // binning, region.columns // binning
        fewest_rows, fewest_columns = (self._connection.integer_bounds(side)[0] for side in ("Height", "Width"))
        if rows < fewest_rows or columns < fewest_columns:
            raise BadValue(
                f"the camera reads out at least {fewest_rows * binning} rows and {fewest_columns * binning} columns"
            )
        self._connection.call("arv_camera_set_region", region.left // binning, region.top // binning, columns, rows)

    def nearest(self, region: Region) -> Region:
        """Return the largest region in whole steps within this one."""
        binning = self.binning()
        top, left, rows, columns = (self._step(side) * binning for side in ("OffsetY", "OffsetX", "Height", "Width"))
        return Region(
            region.top - region.top % top,
            region.left - region.left % left,
            max(rows, region.rows - region.rows % rows),
            max(columns, region.columns - region.columns % columns),
        )

    def _values(self, axis: str) -> dict[int, str]:
        """Binnings of an axis with their text: numbers, or choices such as X2."""
        choices = attempt(self._connection.choices, axis)
        if choices is not None:
            return {number: choice for choice in choices if (number := trailing_number(choice))}
        low, high, step = self._connection.integer_bounds(axis)
        return {number: str(number) for number in range(max(low, 1), min(high, _LARGEST_BINNING) + 1, step)}

    def _length(self, side: str, longest: str, sensor: str, binning: int) -> int:
        """Longest side in whole steps; 2064 pixels in steps of 16 give 2048 with a binning of 2."""
        connection = self._connection
        binned, whole = (attempt(connection.integer, name) for name in (longest, sensor))
        most = min(length for length in (binned and binned * binning, whole, math.inf) if length)
        if most == math.inf:  # the limit of the side itself may shrink with the offset
            most = connection.integer_bounds(side)[1] * binning
        step = self._step(side) * binning
        return int(most - most % step)

    def _step(self, side: str) -> int:
        if side.startswith("Offset") and not self.has_offsets:
            return 1
        return self._connection.integer_bounds(side)[2]
