"""Features that are reset when a camera is opened, because a leftover value falsifies frames or exposures."""

from typing import Final

from drivers.genicam.connection import GenicamConnection

# In this order: the exposure mode, for example, may lock the automatic exposure. The first value that fits is set.
_OFF: Final = ("false", "Off")
_ONE: Final = ("1", "X1", "Off")
FRAME_RATE: Final[dict[str, tuple[str, ...]]] = {  # a leftover rate caps the exposure
    "AcquisitionFrameRateEnable": _OFF,
    "AcquisitionFrameRateEnabled": _OFF,
}
RESETS: Final[dict[str, tuple[str, ...]]] = {
    "AcquisitionMode": ("Continuous",),
    "ExposureMode": ("Timed",),
    "ExposureAuto": ("Off",),
    "GainAuto": ("Off",),
    **FRAME_RATE,
    "Gamma": ("1",),  # before it is disabled, which may lock it
    "GammaEnable": _OFF,
    "GammaEnabled": _OFF,
    "SequencerMode": _OFF,  # cycles exposure and gain
    "SequencerEnable": _OFF,
    "TestPattern": _OFF,
    "TestPatternEnable": _OFF,
    "TestImageSelector": _OFF,
    "BlackLevelAuto": _OFF,
    "DefectCorrectStaticEnable": _OFF,
    "DefectCorrectionEnable": _OFF,
    "DefectCorrectionMode": _OFF,
    "BslDefectPixelCorrectionMode": _OFF,
    "SharpnessEnabled": _OFF,
    "SharpeningEnable": _OFF,
    "SharpnessEnhancement": ("1",),  # 1 changes nothing
    "BslSharpnessEnhancement": ("1",),
    "Sharpness": ("0",),
    "SharpnessAuto": _OFF,
    "NoiseReduction": ("0", "Off"),
    "NoiseReductionEnable": _OFF,
    "BslNoiseReduction": ("0",),
    "HDREnable": _OFF,
    "HDRMode": _OFF,
    "DigitalShift": ("0",),
    "ImageCompressionMode": _OFF,  # its frames would be too short
    "IspEnable": _OFF,  # after what it contains
    "LUTEnable": _OFF,
    "DecimationVertical": _ONE,
    "DecimationHorizontal": _ONE,
    "BinningVertical": _ONE,
    "BinningHorizontal": _ONE,
    "ReverseX": _OFF,
    "ReverseY": _OFF,
    "ChunkModeActive": _OFF,
    "GevSCPSBigEndian": _OFF,
    "pgrPixelBigEndian": _OFF,
}


def reset(line: GenicamConnection, features: dict[str, tuple[str, ...]]) -> None:
    """Reset features where they are writable; what the camera refuses stays, and shows in its properties."""
    for feature, values in features.items():
        _reset(line, feature, values)


def _reset(line: GenicamConnection, feature: str, values: tuple[str, ...]) -> None:
    """Set a feature to the first of the values that fits its type."""
    before = line.optional_text(feature)
    if before is None or before in values or not line.is_writable(feature):
        return
    choices = line.attempt(lambda: line.choices(feature))  # None if it is no enumeration
    fitting = [value for value in values if choices is None or value in choices]
    if fitting:
        line.attempt(lambda: line.set_text(feature, fitting[0]))
