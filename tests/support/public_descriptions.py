"""Names in public camera descriptions of features that change counts: what another program may leave switched on.

Facts of the 88 descriptions of cameras in areaDetector's ADGenICam, by maker and with the number of
descriptions. The descriptions themselves are not here.
"""

from __future__ import annotations

from typing import Final

from support.genicam_descriptions import Description

Kind = tuple[str, str] | int | None  # a selection: harmful, harmless; a number: harmless; None: a switch

PUBLIC: Final[dict[str, dict[str, Kind]]] = {
    "Allied Vision, 33": {
        "DefectMaskColumnEnable": ("Enabled", "Disabled"),
        "DefectMaskPixelEnable": ("Enabled", "Disabled"),
        "DefectMaskEnable": None,
        "EdgeFilter": ("Smooth2", "Off"),
        "TestPattern": ("GreyDiagonalRamp", "Off"),
        "CorrectionMode": ("On", "Off"),
        "ContrastEnable": None,
        "ContrastAuto": ("Once", "Off"),
        "Sharpness": 0,
    },
    "Basler, 15": {
        "TestPattern": ("Black", "Off"),
        "TestImageSelector": ("Testimage1", "Off"),
        "BslStaticDefectPixelCorrectionMode": ("Factory", "Off"),
        "BslContrastMode": ("SCurve", "Linear"),
        "BslContrast": 0,
        "DigitalShift": 0,
        "GammaEnable": None,
        "VendorDefectPixelCorr": None,
        "MedianFilter": None,
        "DenoisingEnable": None,
        "ContrastMode": ("ContrastMode_Linear", "ContrastMode_Off"),
        "ContrastEnable": None,
        "Sharpness": 0,
        "SharpnessEnhancementAbs": 1,
        "NoiseReductionAbs": 0,
        "VignettingCorrectionMode": ("On", "Off"),
    },
    "FLIR and Point Grey, 34": {
        "SequencerMode": ("On", "Off"),
        "TestPattern": ("Increment", "Off"),
        "TestImageSelector": ("TestImage1", "Off"),
        "DefectCorrectStaticEnable": None,
        "pgrDefectPixelCorrectionEnable": None,
        "SharpeningAuto": None,
        "SharpeningEnable": None,
        "SharpnessEnabled": None,
        "SharpnessAuto": ("Once", "Off"),
        "Sharpness": 0,
        "ImageCompressionMode": ("Lossless", "Off"),
        "IspEnable": None,
        "GammaEnabled": None,
        "BlackLevelAuto": ("Once", "Off"),
        "LensShadingCorrectionMode": ("Active", "Off"),
        "pgrExposureCompensationAuto": ("Once", "Off"),
        "pgrHDRModeEnabled": None,
    },
    "Adimec, Mikrotron and Viewworks, 3": {
        "TestImageSelector": ("AdimecTestPattern", "Off"),
        "TestPattern": ("GreyHorizontalRamp", "Off"),
        "DefectPixelCorrectionEnable": None,
        "HDR_Mode": ("MultiSlope2Slopes", "Off"),
        "SequencerMode": ("On", "Off"),
    },
}


def leave_switched_on(of: Description, features: dict[str, Kind]) -> dict[str, str]:
    """Add features to a description with harmful values; return the harmless ones, as the driver reads them."""
    for name, kind in features.items():
        if kind is None:
            of.boolean(name, 1)
        elif isinstance(kind, int):
            of.integer(name, 3, 0, 4)
        else:
            of.enumeration(name, kind[0], {each: number for number, each in enumerate(kind)})
    return {name: _harmless(kind) for name, kind in features.items()}


def _harmless(kind: Kind) -> str:
    if kind is None:
        return "false"
    return str(kind) if isinstance(kind, int) else kind[1]
