"""Hamamatsu's DCAM-API 4 through ctypes: structures, functions, cameras, errors."""

import ctypes
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from ctypes import POINTER, Structure, byref, c_char_p, c_double, c_int32, c_uint32, c_void_p
from dataclasses import dataclass
from functools import cache
from typing import Any

from drivers.camera import GONE, NO_MEMORY
from drivers.device import choose
from drivers.errors import BadValue, Busy, DeviceError, DeviceTimeout, Disconnected, FrameLost, Unsupported, WrongState


def sized(kind: type[Structure], **values: Any) -> Structure:
    """Return a structure whose first member is its own size, as every call requires."""
    made = kind(**values)
    setattr(made, made._fields_[0][0], ctypes.sizeof(kind))
    return made


def _int32(names: str) -> list[tuple[str, Any]]:
    return [(name, c_int32) for name in names.split()]


def _structure(name: str, *fields: tuple[str, Any]) -> type[Structure]:
    return type(name, (Structure,), {"_fields_": fields})


# Laid out for 64-bit pointers.
Init = _structure(
    "Init", *_int32("size iDeviceCount reserved initoptionbytes"), ("initoption", c_void_p), ("guid", c_void_p)
)
DeviceOpen = _structure("DeviceOpen", *_int32("size index"), ("hdcam", c_void_p))
DeviceString = _structure("DeviceString", *_int32("size iString"), ("text", c_char_p), *_int32("textbytes"))
PropertyAttribute = _structure(
    "PropertyAttribute",
    *_int32("cbSize iProp option iReserved1 attribute iGroup iUnit attribute2"),
    *[(name, c_double) for name in ("valuemin", "valuemax", "valuestep", "valuedefault")],
    *_int32("nMaxChannel iReserved3 nMaxView iProp_NumberOfElement iProp_ArrayBase iPropStep_Element"),
)
PropertyValueText = _structure(
    "PropertyValueText", *_int32("cbSize iProp"), ("value", c_double), ("text", c_char_p), *_int32("textbytes")
)
TimeStamp = _structure("TimeStamp", ("sec", c_uint32), ("microsec", c_int32))
TransferInfo = _structure("TransferInfo", *_int32("size iKind nNewestFrameIndex nFrameCount"))
BufferFrame = _structure(
    "BufferFrame",
    *_int32("size iKind option iFrame"),
    ("buf", c_void_p),
    *_int32("rowbytes type width height left top"),
    ("timestamp", TimeStamp),
    *_int32("framestamp camerastamp"),
)
WaitOpen = _structure("WaitOpen", *_int32("size supportevent"), ("hwait", c_void_p), ("hdcam", c_void_p))
WaitStart = _structure("WaitStart", *_int32("size eventhappened eventmask timeout"))


class NotThere(Unsupported):
    """The camera has no such property, or no next one."""


class Denied(WrongState):
    """A busy camera does not allow access to this property."""


# Messages, and the codes (unsigned) with their names in Hamamatsu's header; the library returns negative numbers.
_TABLE: dict[type[DeviceError], dict[str, str]] = {
    WrongState: {
        "the camera cannot do this in its present state": (
            "80000101 BUSY, 80000103 NOTREADY, 80000104 NOTSTABLE, 80000105 UNSTABLE, 80000107 NOTBUSY"
        ),
        "the wait for a frame was aborted": "80000102 ABORT",
    },
    Denied: {"a running camera does not allow this: stop it first": "8000082C ACCESSDENY"},
    DeviceTimeout: {
        "the camera did not answer in time": "80000106 TIMEOUT",
        "no trigger reached the camera": "80000303 NOTRIGGER",
    },
    Busy: {
        "the camera cannot be opened: another program holds it (close it), or the camera is switched off": (
            "80000110 EXCLUDED, 81001001 FAILOPENBUS, 82001001 FAILOPENCAMERA"
        )
    },
    DeviceError: {
        "the computer lacks a resource that the camera needs": "80000201 NORESOURCE",
        NO_MEMORY: ("80000203 NOMEMORY, 8000083F LESSSYSTEMMEMORY"),
        "the camera's cooling fails: check its fan or water": "80000302 COOLINGTROUBLE",
        "the camera warns of its temperature: check its cooling": "80000304 TEMPERATURE_TROUBLE",
    },
    Unsupported: {
        "Hamamatsu's driver for the camera's interface is missing or damaged: install the DCAM-API again": (
            "80000204 NOMODULE, 80000205 NODRIVER, 80000211 INVALIDMODULE"
        ),
        "the camera needs a newer DCAM-API: install it from Hamamatsu": "84002002 NEWRUNTIMEREQUIRED",
        "the frame grabber of the camera is missing, or its driver": "80000207 NOGRABBER",
        "this camera cannot do this, or not in its present mode": (
            "80000823 NOTWRITABLE, 80000824 NOTREADABLE, 80000F02 NOTIMPLEMENT, 80000F03 NOTSUPPORT"
        ),
        "frame bundling must be off: switch it off in Hamamatsu's program": "80000832 FRAMEBUNDLESHOULDBEOFF",
    },
    Disconnected: {
        "no Hamamatsu camera was found: check its power and cable, and that no other program holds it": (
            "80000206 NOCAMERA"
        ),
        GONE: (
            "80000806 INVALIDCAMERA, 80000807 INVALIDHANDLE, 80000F01 UNREACH, 80000F07 NOCONNECTION, "
            "83001002 FAILREADCAMERA, 83001003 FAILWRITECAMERA, 84002001 INVALIDWAITHANDLE"
        ),
        "Hamamatsu's DCAM-API has ended: connect again": "80000F04 UNLOADED",
    },
    FrameLost: {
        "a frame was lost or damaged in transfer": (
            "80000301 LOSTFRAME, 80000321 INVALIDIMAGE, 80000833 INVALIDFRAMEINDEX, 80000F06 MISSINGFRAME_TROUBLE"
        ),
        "triggers come faster than the camera can take frames": "80000305 TOOFREQUENTTRIGGER",
    },
    BadValue: {
        "the camera refused the value": (
            "80000808 INVALIDPARAM, 80000821 INVALIDVALUE, 80000822 OUTOFRANGE, 8000082E WRONGPROPERTYVALUE"
        ),
        "the camera refused the region": "8000082B INVALIDSUBARRAY",
    },
    NotThere: {
        "this camera cannot do this, or not in its present mode": "80000825 INVALIDPROPERTYID, 80000828 NOPROPERTY"
    },
}
ERRORS = {
    int(code, 16): (name, kind, message)
    for kind, messages in _TABLE.items()
    for message, codes in messages.items()
    for code, name in (pair.split() for pair in codes.split(", "))
}


def error_of(code: int, what: str) -> DeviceError:
    """Return the error for a code, signed or not, that `what` returned."""
    unsigned = code & 0xFFFFFFFF
    name, kind, message = ERRORS.get(unsigned, ("unknown", DeviceError, "the camera reports an error"))
    return kind(f"{message} ({what}: {name}, {unsigned:08x})")


FILE = "dcamapi.dll" if sys.platform == "win32" else "libdcamapi.so"

TEXT_BYTES = 256
_HANDLE = c_void_p  # without prototypes ctypes would pass 32 bits
PROTOTYPES: dict[str, tuple[type, ...]] = {
    "dcamapi_init": (POINTER(Init),),
    "dcamapi_uninit": (),
    "dcamdev_open": (POINTER(DeviceOpen),),
    "dcamdev_close": (_HANDLE,),
    "dcamdev_getstring": (_HANDLE, POINTER(DeviceString)),
    "dcamprop_getattr": (_HANDLE, POINTER(PropertyAttribute)),
    "dcamprop_getvalue": (_HANDLE, c_int32, POINTER(c_double)),
    "dcamprop_setgetvalue": (_HANDLE, c_int32, POINTER(c_double), c_int32),
    "dcamprop_queryvalue": (_HANDLE, c_int32, POINTER(c_double), c_int32),
    "dcamprop_getnextid": (_HANDLE, POINTER(c_int32), c_int32),
    "dcamprop_getname": (_HANDLE, c_int32, c_char_p, c_int32),
    "dcamprop_getvaluetext": (_HANDLE, POINTER(PropertyValueText)),
    "dcambuf_alloc": (_HANDLE, c_int32),
    "dcambuf_release": (_HANDLE, c_int32),
    "dcambuf_copyframe": (_HANDLE, POINTER(BufferFrame)),
    "dcamcap_start": (_HANDLE, c_int32),
    "dcamcap_stop": (_HANDLE,),
    "dcamcap_status": (_HANDLE, POINTER(c_int32)),
    "dcamcap_transferinfo": (_HANDLE, POINTER(TransferInfo)),
    "dcamwait_open": (POINTER(WaitOpen),),
    "dcamwait_close": (_HANDLE,),
    "dcamwait_start": (_HANDLE, POINTER(WaitStart)),
    "dcamwait_abort": (_HANDLE,),
}


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


@dataclass(frozen=True, slots=True)
class ListedCamera:
    """A camera in the session, not yet opened."""

    index: int
    name: str  # maker, model and serial number
    serial_number: str


class DcamLibrary:
    """The DCAM-API's functions by name, and the process's session with it."""

    def __init__(self, path: str) -> None:
        try:
            loaded = ctypes.CDLL(path)
            self._functions = {name: _typed(loaded[name], types) for name, types in PROTOTYPES.items()}
        except (OSError, AttributeError) as error:
            raise Unsupported(
                f"Hamamatsu's DCAM-API cannot be loaded ({error}): install it from Hamamatsu,"
                " or give the path of its library as camera.library"
            ) from error
        self._lock = threading.Lock()
        self.users = self._cameras = 0  # of the session

    def call(self, name: str, *arguments: object) -> None:
        """Call a function; raise the error for its code."""
        try:
            code = self._functions[name](*arguments)
        except OSError as error:  # Windows: the library crashed
            raise Disconnected(f"Hamamatsu's DCAM-API failed in {name} ({error}): connect again") from error
        if code < 0:
            raise error_of(code, name)

    def text(self, name: str, target: int, kind: type[Structure], **values: Any) -> str:
        """Call a function of a camera that writes a text."""
        text = ctypes.create_string_buffer(TEXT_BYTES)
        request = sized(kind, textbytes=TEXT_BYTES, **values)
        request.text = ctypes.cast(text, c_char_p)
        self.call(name, target, byref(request))
        return text.value.decode(errors="replace").strip()

    def string(self, camera: int, identifier: int) -> str:
        """Return one of the `STRINGS` of a camera, given by its handle if open, else by its index."""
        return self.text("dcamdev_getstring", camera, DeviceString, iString=identifier)

    def begin(self) -> int:
        """Join the session, or begin it, which searches for cameras; return their number."""
        with self._lock:
            if not self.users:
                answer = sized(Init)
                try:
                    self.call("dcamapi_init", byref(answer))
                except DeviceError:
                    with suppress(DeviceError):  # without it every later attempt of this process fails, too
                        self.call("dcamapi_uninit")
                    raise
                self._cameras = answer.iDeviceCount
            self.users += 1
            return self._cameras

    def end(self) -> None:
        """Leave the session; the last user ends it, so that the next one searches for cameras again."""
        with self._lock:
            self.users -= 1
            if not self.users:
                self.call("dcamapi_uninit")

    def connected(self) -> tuple[ListedCamera, ...]:
        """Return the connected cameras."""
        try:
            count = self.begin()
        except Disconnected:  # the DCAM-API's error for no camera
            return ()
        try:
            return tuple(map(self._listed, range(count)))
        finally:
            self.end()

    def chosen(self, count: int, wanted: str) -> ListedCamera:
        """Return the camera of this serial number or index, "" for the only one of `count`; needs a session."""
        cameras = [self._listed(index) for index in range(count)]
        names = [(camera.serial_number, str(camera.index)) for camera in cameras]
        return cameras[choose(wanted, names, what="Hamamatsu camera", setting="device")]

    def _listed(self, index: int) -> ListedCamera:
        vendor, model, serial = (self.string(index, STRINGS[name]) for name in ("vendor", "model", "serial number"))
        serial = serial.removeprefix("S/N:").strip()
        return ListedCamera(index, f"{vendor} {model}, serial {serial}", serial)


@cache
def load_library(path: str = "") -> DcamLibrary:
    """Return the library at this path, "" for the installed one; loaded once per process."""
    return DcamLibrary(path or FILE)


def _typed(function: Callable[..., int], types: tuple[type, ...]) -> Callable[..., int]:
    function.argtypes = types  # type: ignore[attr-defined] # a ctypes function
    function.restype = c_int32  # type: ignore[attr-defined] # the same
    return function
