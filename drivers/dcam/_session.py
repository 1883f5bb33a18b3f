"""The process's session with the DCAM-API and the cameras listed in it."""

import threading
from contextlib import suppress
from ctypes import byref
from dataclasses import dataclass

from drivers.dcam._library import DcamLibrary, DeviceString, Init, sized
from drivers.device import choose
from drivers.errors import DeviceError, Disconnected

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


@dataclass(slots=True)
class _Session:
    cameras: int
    users: int = 0


_sessions: dict[DcamLibrary, _Session] = {}
_lock = threading.Lock()


@dataclass(frozen=True, slots=True)
class ListedCamera:
    """A camera in the session, not yet opened."""

    index: int
    name: str  # maker, model and serial number
    serial_number: str


def begin(library: DcamLibrary) -> int:
    """Join the session, or begin it, which searches for cameras; return their number."""
    with _lock:
        session = _sessions.get(library)
        if session is None:
            answer = sized(Init)
            try:
                library.call("dcamapi_init", byref(answer))
            except DeviceError:
                with suppress(DeviceError):  # without it every later attempt of this process fails, too
                    library.call("dcamapi_uninit")
                raise
            session = _sessions[library] = _Session(answer.iDeviceCount)
        session.users += 1
        return session.cameras


def end(library: DcamLibrary) -> None:
    """Leave the session; the last user ends it, so that the next one searches for cameras again."""
    with _lock:
        session = _sessions[library]
        session.users -= 1
        if not session.users:
            del _sessions[library]
            library.call("dcamapi_uninit")


def connected(library: DcamLibrary) -> tuple[ListedCamera, ...]:
    """Return the connected cameras."""
    try:
        count = begin(library)
    except Disconnected:  # the DCAM-API's error for no camera
        return ()
    try:
        return tuple(_listed(library, index) for index in range(count))
    finally:
        end(library)


def chosen(library: DcamLibrary, count: int, wanted: str) -> ListedCamera:
    """Return the camera of this serial number or index, "" for the only one of `count`; needs a session."""
    cameras = [_listed(library, index) for index in range(count)]
    names = [(camera.serial_number, str(camera.index)) for camera in cameras]
    return cameras[choose(wanted, names, "Hamamatsu camera", "device")]


def string(library: DcamLibrary, camera: int, identifier: int) -> str:
    """Return one of the `STRINGS` of a camera, given by its handle if open, else by its index."""
    return library.text("dcamdev_getstring", camera, DeviceString, iString=identifier)


def _listed(library: DcamLibrary, index: int) -> ListedCamera:
    vendor, model, serial = (string(library, index, STRINGS[name]) for name in ("vendor", "model", "serial number"))
    serial = serial.removeprefix("S/N:").strip()
    return ListedCamera(index, f"{vendor} {model}, serial {serial}", serial)
