"""Which cameras the DCAM-API knows: asked without opening them."""

from __future__ import annotations

from ctypes import byref, c_char_p, cast, create_string_buffer
from dataclasses import dataclass

from drivers.dcam import session
from drivers.dcam.library import DcamLibrary, load_library
from drivers.dcam.structures import DeviceString, sized
from drivers.discovery import Found
from drivers.errors import BadValue, Disconnected

STRINGS = {
    "bus": 0x04000101,
    "serial number": 0x04000102,
    "vendor": 0x04000103,
    "model": 0x04000104,
    "camera version": 0x04000105,
    "driver version": 0x04000106,
    "module version": 0x04000107,
    "DCAM-API version": 0x04000108,
}
_TEXT_BYTES = 256


@dataclass(frozen=True, slots=True)
class Listed:
    """A camera that could be opened, unless another program holds it."""

    index: int
    vendor: str
    model: str
    serial_number: str

    @property
    def name(self) -> str:
        """Maker, model and serial number."""
        return f"{self.vendor} {self.model}, serial {self.serial_number}"


def find(library: DcamLibrary | None = None) -> tuple[Found, ...]:
    """Return the cameras that are there, perhaps none; raise `Unsupported` where Hamamatsu's library is missing."""
    library = library or load_library()
    try:
        count = session.begin(library)
    except Disconnected:  # that there is none is an error to the DCAM-API
        return ()
    try:
        listed = [_listed(library, index) for index in range(count)]
    finally:
        session.end(library)
    return tuple(
        Found(kind="camera", driver="dcam", description=camera.name, settings={"device": camera.serial_number})
        for camera in listed
    )


def choose(library: DcamLibrary, count: int, wanted: str) -> Listed:
    """Return the camera of this serial number or index among `count`; "" asks for the only one. In a session."""
    found = [_listed(library, index) for index in range(count)]
    chosen = [camera for camera in found if wanted in {"", camera.serial_number, str(camera.index)}]
    if len(chosen) == 1:
        return chosen[0]
    names = "; ".join(camera.name for camera in found)
    if chosen:
        raise BadValue(f"there are {len(chosen)} Hamamatsu cameras; say which by its serial number: {names}")
    raise Disconnected(f"there is no Hamamatsu camera {wanted}; there are {names}")


def string(library: DcamLibrary, camera: int, identifier: int) -> str:
    """Return what an open camera, by its handle, or one that is not, by its index, says of itself."""
    text = create_string_buffer(_TEXT_BYTES)
    asked = sized(DeviceString, iString=identifier, textbytes=_TEXT_BYTES)
    asked.text = cast(text, c_char_p)
    library.call("dcamdev_getstring", camera, byref(asked))
    return text.value.decode(errors="replace").strip()


def _listed(library: DcamLibrary, index: int) -> Listed:
    vendor, model, serial = (string(library, index, STRINGS[name]) for name in ("vendor", "model", "serial number"))
    return Listed(index, vendor, model, serial.removeprefix("S/N:").strip())
