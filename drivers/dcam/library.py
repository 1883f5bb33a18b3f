"""Hamamatsu's DCAM-API library: functions with prototypes, failures as device errors."""

import ctypes
import sys
from collections.abc import Callable
from ctypes import POINTER, c_char_p, c_double, c_int32, c_void_p
from functools import cache

from drivers.dcam import structures as s
from drivers.dcam.errors import error_of
from drivers.errors import Disconnected, Unsupported

FILE = "dcamapi.dll" if sys.platform == "win32" else "libdcamapi.so"

_HANDLE = c_void_p  # without prototypes ctypes would pass 32 bits
PROTOTYPES: dict[str, tuple[type, ...]] = {
    "dcamapi_init": (POINTER(s.Init),),
    "dcamapi_uninit": (),
    "dcamdev_open": (POINTER(s.DeviceOpen),),
    "dcamdev_close": (_HANDLE,),
    "dcamdev_getstring": (_HANDLE, POINTER(s.DeviceString)),
    "dcamprop_getattr": (_HANDLE, POINTER(s.PropertyAttribute)),
    "dcamprop_getvalue": (_HANDLE, c_int32, POINTER(c_double)),
    "dcamprop_setgetvalue": (_HANDLE, c_int32, POINTER(c_double), c_int32),
    "dcamprop_queryvalue": (_HANDLE, c_int32, POINTER(c_double), c_int32),
    "dcamprop_getnextid": (_HANDLE, POINTER(c_int32), c_int32),
    "dcamprop_getname": (_HANDLE, c_int32, c_char_p, c_int32),
    "dcamprop_getvaluetext": (_HANDLE, POINTER(s.PropertyValueText)),
    "dcambuf_alloc": (_HANDLE, c_int32),
    "dcambuf_release": (_HANDLE, c_int32),
    "dcambuf_copyframe": (_HANDLE, POINTER(s.BufferFrame)),
    "dcamcap_start": (_HANDLE, c_int32),
    "dcamcap_stop": (_HANDLE,),
    "dcamcap_status": (_HANDLE, POINTER(c_int32)),
    "dcamcap_transferinfo": (_HANDLE, POINTER(s.TransferInfo)),
    "dcamcap_firetrigger": (_HANDLE, c_int32),
    "dcamwait_open": (POINTER(s.WaitOpen),),
    "dcamwait_close": (_HANDLE,),
    "dcamwait_start": (_HANDLE, POINTER(s.WaitStart)),
    "dcamwait_abort": (_HANDLE,),
}


class DcamLibrary:
    """The DCAM-API's functions by name."""

    def __init__(self, path: str) -> None:
        try:
            loaded = ctypes.CDLL(path)
            self._functions = {name: _typed(loaded[name], types) for name, types in PROTOTYPES.items()}
        except (OSError, AttributeError) as error:
            raise Unsupported(
                f"Hamamatsu's DCAM-API cannot be loaded ({error}): install it from Hamamatsu,"
                " or give the path of its library as camera.library"
            ) from error

    def call(self, name: str, *arguments: object) -> None:
        """Call a function; raise the error for its code."""
        try:
            code = self._functions[name](*arguments)
        except OSError as error:  # Windows: the library crashed
            raise Disconnected(f"Hamamatsu's DCAM-API failed in {name} ({error}): connect again") from error
        if code < 0:
            raise error_of(code, name)


@cache
def load_library(path: str = "") -> DcamLibrary:
    """Return the library at this path, "" for the installed one; loaded once per process."""
    return DcamLibrary(path or FILE)


def _typed(function: Callable[..., int], types: tuple[type, ...]) -> Callable[..., int]:
    function.argtypes = types  # type: ignore[attr-defined] # a ctypes function
    function.restype = c_int32  # type: ignore[attr-defined] # the same
    return function
