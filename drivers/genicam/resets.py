"""Features that are reset when a camera is opened, because a leftover value falsifies frames or exposures."""

from typing import Final

from drivers.genicam.connection import GenicamConnection

# In this order: the exposure mode, for example, may lock the automatic exposure. The first value that fits is set.
_OFF: Final = ("false", "Off", "Disabled", "ContrastMode_Off")
_ONE: Final = ("1", "X1", "Off")
FRAME_RATE: Final[dict[str, tuple[str, ...]]] = {  # a leftover rate caps the exposure
    "AcquisitionFrameRateEnable": _OFF,
    "AcquisitionFrameRateEnabled": _OFF,
}
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
    "SharpnessEnhancement": ("1",),  # 1 changes nothing
    "SharpnessEnhancementAbs": ("1",),
    "BslSharpnessEnhancement": ("1",),
    "Sharpness": ("0",),
    "NoiseReduction": ("0", "Off"),
    "NoiseReductionAbs": ("0",),
    "BslNoiseReduction": ("0",),
    "BslContrastMode": ("Linear",),
    "BslContrast": ("0",),
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
