"""Models of real GenICam cameras, with odd, missing, locked and leftover features."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from genicam_descriptions import PFNC, Description
from gige_camera import GigeCamera, Image
from numpy.typing import NDArray

from drivers.genicam._frames import PIXEL_FORMATS

ROWS, COLUMNS = 48, 96
_NAMES: Final = {number: name for name, number in PFNC.items()}
ON_OFF: Final = {"Off": 0, "On": 1}
Change = Callable[[GigeCamera, Description], None]


@dataclass(frozen=True)
class Model:
    """A camera to be imitated."""

    vendor: str
    name: str
    description: Description
    pixels: Callable[[int, int], NDArray[np.uint16]] | None = None  # (rows, columns), as a 16-bit format sends them
    byte_order: str = "<"
    row_padding_bytes: int = 0
    trailing_bytes: int = 0
    after_write: Change = lambda _camera, _description: None  # what the firmware adapts


def ramp(rows: int, columns: int, most: int = 4095) -> NDArray[np.uint16]:
    """Return different counts that end at the largest one."""
    return (most - np.arange(rows * columns) * 7 % (most + 1)).reshape(rows, columns).astype(np.uint16)


def stored(pixels: NDArray[np.uint16], model: Model, name: str) -> bytes:
    """Return the pixels in a format of 8 or 16 bits, or packed by its definition."""
    pixel_format = PIXEL_FORMATS[name]
    if pixel_format.packing == "none":
        return b"".join(
            row.astype("u1" if pixel_format.bits == 8 else f"{model.byte_order}u2").tobytes()
            + bytes(model.row_padding_bytes)
            for row in pixels
        )
    assert pixel_format.bits == 12
    first, second = pixels.ravel()[::2].astype(int), pixels.ravel()[1::2].astype(int)
    if pixel_format.packing == "pfnc":
        parts = (first & 255, first >> 8 | (second & 15) << 4, second >> 4)
    else:
        parts = (first >> 4, first & 15 | (second & 15) << 4, second >> 4)
    return np.stack(parts, axis=1).astype(np.uint8).tobytes()


def switched_on(model: Model) -> GigeCamera:
    """Return the camera; it adapts its payload size, and sends pixels in the format that is set."""
    of = model.description

    def value(camera: GigeCamera, feature: str) -> int:
        return camera.register(of.addresses[feature])

    def adapt(camera: GigeCamera) -> None:
        model.after_write(camera, of)
        size = PIXEL_FORMATS[_NAMES[value(camera, "PixelFormat")]].size_bytes(
            value(camera, "Width") * value(camera, "Height")
        )
        padding = model.row_padding_bytes * value(camera, "Height") + model.trailing_bytes
        camera.set_register(of.addresses["PayloadSize"], size + padding)

    def image(camera: GigeCamera) -> Image:
        rows, columns, number = (value(camera, feature) for feature in ("Height", "Width", "PixelFormat"))
        name = _NAMES[number]
        bits = PIXEL_FORMATS[name].bits
        pixels = (model.pixels or (lambda rows, columns: ramp(rows, columns, 2**bits - 1)))(rows, columns)
        content = stored(pixels, model, name) + bytes(model.trailing_bytes)
        return Image(content, rows, columns, number, model.row_padding_bytes)

    camera = GigeCamera(
        of.xml(model.vendor, model.name),
        vendor=model.vendor,
        model=model.name,
        image=image,
        start_address=of.addresses["Running"],
        after_write=adapt,
    )
    for feature, number in of.values.items():
        camera.set_register(of.addresses[feature], number)
    adapt(camera)
    return camera


def usual(formats: tuple[str, ...], *, step: int = 2, offsets: bool = True) -> Description:
    """Return the features that most cameras have, with leftover settings that falsify frames."""
    of = Description()
    of.basics(ROWS, COLUMNS, formats, step=step, offsets=offsets)
    of.enumeration("ExposureMode", "TriggerWidth", {"Timed": 1, "TriggerWidth": 2})
    of.enumeration("ExposureAuto", "Continuous", {"Off": 0, "Continuous": 2})
    of.number("Gamma", 2, 0, 4)
    of.boolean("LUTEnable", 1)
    of.boolean("ReverseX", 1)
    of.boolean("ReverseY", 1)
    of.integer("DecimationHorizontal", 2, 1, 4)
    of.integer("DecimationVertical", 2, 1, 4)
    of.enumeration("TriggerMode", "On", ON_OFF)
    of.enumeration("TriggerSource", "Line0", {"Software": 0, "Line0": 1})
    return of


def grasshopper3() -> Model:
    """USB3, 12 bits: left-aligned in Mono16; the horizontal binning is locked and follows the vertical one."""
    of = usual(("Mono8", "Mono16", "Mono12Packed", "Mono12p"))
    of.number("ExposureTime", 9000, 10, 1e6)
    of.integer("BinningVertical", 1, 1, 2)
    of.raw('<Integer Name="HorizontalLocked"><Value>1</Value></Integer>')
    of.integer("BinningHorizontal", 1, 1, 2, more="<pIsLocked>HorizontalLocked</pIsLocked>")
    of.boolean("GammaEnabled", 1)
    of.boolean("SharpnessEnabled", 1)
    of.number("AcquisitionFrameRate", 5, 1, 160)
    of.boolean("AcquisitionFrameRateEnabled", 1)
    of.enumeration("AcquisitionFrameRateAuto", "Off", {"Off": 0, "Continuous": 1})
    of.number("BlackLevel", 3)
    of.number("DeviceTemperature", 41)

    def follow(camera: GigeCamera, of: Description) -> None:
        binning = camera.register(of.addresses["BinningVertical"])
        camera.set_register(of.addresses["BinningHorizontal"], binning)
        bin_sides(camera, of, binning)

    return Model("Point Grey Research", "Grasshopper3 GS3-U3-51S5M", of, left_aligned, after_write=follow)


def left_aligned(rows: int, columns: int) -> NDArray[np.uint16]:
    return ramp(rows, columns) * 16


def bin_sides(camera: GigeCamera, of: Description, binning: int) -> None:
    """Shrink the region to the binned sensor."""
    for side, length in (("Width", COLUMNS), ("Height", ROWS)):
        camera.set_register(of.addresses[f"{side}Max"], length // binning)
        if camera.register(of.addresses[side]) > length // binning:
            camera.set_register(of.addresses[side], length // binning)


def blackfly() -> Model:
    """GigE: sends Mono16 big-endian, and its trigger selector is read-only."""
    of = usual(("Mono8", "Mono16", "Mono12Packed"))
    of.number("ExposureTime", 9000, 10, 1e6)
    of.boolean("pgrPixelBigEndian", 0)
    selector = '<ImposedAccessMode>RO</ImposedAccessMode><EnumEntry Name="ExposureStart"><Value>0</Value></EnumEntry>'
    of.raw(f'<Enumeration Name="TriggerSelector">{selector}<pValue>TriggerSelectorInt</pValue></Enumeration>')
    of.raw(
        '<IntSwissKnife Name="TriggerSelectorInt"><pVariable Name="M">TriggerModeReg</pVariable>'
        "<Formula>M * 0</Formula></IntSwissKnife>"
    )
    return Model("Point Grey Research", "Blackfly BFLY-PGE-31S4M", of, left_aligned, ">")


def manta() -> Model:
    """GigE, firmware 1.44: the black level is a category, the depth of the digitiser is reported."""
    of = usual(("Mono8", "Mono12Packed", "Mono10", "Mono12", "Mono14"))
    of.number("ExposureTimeAbs", 9000, 10, 1e6)
    of.integer("SensorBits", 12)
    of.raw('<Category Name="BlackLevel"><pFeature>Gamma</pFeature></Category>')
    of.number("AcquisitionFrameRateAbs", 20, 1, 160)
    return Model("Allied Vision Technologies", "Manta_G-125B (E0020008)", of, ramp)


def dhyana() -> Model:
    """The black level is an integer, gamma is missing in this firmware, and frames end with padding."""
    of = usual(("Mono12", "Mono16"))
    of.number("ExposureTime", 9000, 10, 1e6)
    of.integer("BlackLevel", 100)
    of.number("DeviceTemperature", 41)
    of.boolean("GammaEnable", 1, more="<pIsAvailable>Missing</pIsAvailable>")
    of.boolean("SharpnessEnabled", 1, more="<pIsImplemented>Missing</pIsImplemented>")
    of.raw('<Integer Name="Missing"><Value>0</Value></Integer>')
    return Model("Tucsen", "Dhyana 6060", of, trailing_bytes=40)


def scientific_cmos() -> Model:
    """No offsets: it always reads out its whole sensor. Its rows are padded."""
    of = usual(("Mono12",), offsets=False)
    of.values["Width"] = COLUMNS // 2  # cropped by another program
    of.number("ExposureTime", 9000, 10, 1e6)
    return Model("PSL", "SCMOS", of, row_padding_bytes=8)


def viewworks() -> Model:
    """Binnings are choices, and only the vertical one can be set."""
    of = usual(("Mono8", "Mono10", "Mono12"))
    of.number("ExposureTime", 9000, 10, 1e6)
    choices = {"X1": 1, "X2": 2, "X4": 4}
    of.enumeration("BinningVertical", "X2", choices)
    of.enumeration("BinningHorizontal", "X2", choices, more="<ImposedAccessMode>RO</ImposedAccessMode>")

    def follow(camera: GigeCamera, of: Description) -> None:
        binning = camera.register(of.addresses["BinningVertical"])
        camera.set_register(of.addresses["BinningHorizontal"], binning)
        bin_sides(camera, of, binning)

    return Model("Vieworks", "VNP-604MX", of, after_write=follow)


def pco1600() -> Model:
    """The exposure time is an integer."""
    of = usual(("Mono8", "Mono10", "Mono12", "Mono12Packed", "Mono16"))
    of.integer("ExposureTimeAbs", 9000, 5, 10**6)
    return Model("PCO", "XXX", of)


MODELS: Final = (grasshopper3, blackfly, manta, dhyana, scientific_cmos, viewworks, pco1600)
