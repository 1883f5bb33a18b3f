"""The library Aravis (GigE Vision, USB3 Vision) through ctypes, with device errors.

Its GObject introspection would need PyGObject, which pip can only build with system headers.
"""

import ctypes
import ctypes.util
import importlib.util
import sys
from contextlib import suppress
from ctypes import POINTER, c_char_p, c_double, c_int, c_int64, c_size_t, c_uint, c_uint32, c_uint64, c_void_p
from functools import cache
from pathlib import Path
from typing import Any, Final

from drivers.errors import BadValue, Busy, DeviceError, Disconnected, Unsupported, WrongState

HOW_TO_INSTALL: Final = {"darwin": "brew install aravis", "win32": "the extra genicam of svwfs"}.get(
    sys.platform, "sudo apt-get install libaravis-0.8-0"
)

STATUS_SUCCESS: Final = 0  # ArvBufferStatus
PACKET_SOCKET_DISABLED: Final = 1  # ArvGvStreamOption
SOCKET_BUFFER_FIXED: Final = 0  # ArvGvStreamSocketBuffer
READ_WRITE: Final = 2  # ArvGcAccessMode

_NAMES: Final = {
    "linux": ("libaravis-0.8.so.0", "libaravis-0.10.so.0"),
    "darwin": ("libaravis-0.8.dylib", "/opt/homebrew/lib/libaravis-0.8.dylib", "/usr/local/lib/libaravis-0.8.dylib"),
}
_SEARCHED: Final = ("aravis-0.8", "aravis-0.10")
_SEARCHED_ON_WINDOWS: Final = ("libaravis-0.8-0", "aravis-0.8-0", "libaravis-0.10-0", "aravis-0.10-0")  # MSYS2, MSVC
_G_TYPE_INT: Final = 6 << 2


class _Error(ctypes.Structure):
    """GError."""

    _fields_ = (("domain", c_uint32), ("code", c_int), ("message", c_char_p))


class _Value(ctypes.Structure):
    """GValue."""

    _fields_ = (("kind", c_size_t), ("data", c_uint64 * 2))


_ERROR = POINTER(POINTER(_Error))
_INT = POINTER(c_int)
_LONG = POINTER(c_int64)
_FLOAT = POINTER(c_double)
_STRINGS = POINTER(c_char_p)

# Result and argument types; a final _ERROR is supplied by `Aravis.call`, which raises instead.
_FUNCTIONS: Final[dict[str, tuple[Any, tuple[Any, ...]]]] = {
    "arv_get_major_version": (c_uint, ()),
    "arv_get_minor_version": (c_uint, ()),
    "arv_device_error_quark": (c_uint32, ()),
    "arv_device_get_feature": (c_void_p, (c_void_p, c_char_p)),
    "arv_gc_feature_node_is_implemented": (c_int, (c_void_p, _ERROR)),
    "arv_gc_feature_node_is_locked": (c_int, (c_void_p, _ERROR)),
    "arv_gc_feature_node_get_actual_access_mode": (c_int, (c_void_p,)),
    "arv_gc_feature_node_get_value_as_string": (c_char_p, (c_void_p, _ERROR)),
    "arv_gc_feature_node_set_value_from_string": (None, (c_void_p, c_char_p, _ERROR)),
    "arv_update_device_list": (None, ()),
    "arv_get_n_devices": (c_uint, ()),
    "arv_get_device_id": (c_char_p, (c_uint,)),
    "arv_get_device_vendor": (c_char_p, (c_uint,)),
    "arv_get_device_model": (c_char_p, (c_uint,)),
    "arv_get_device_serial_nbr": (c_char_p, (c_uint,)),
    "arv_camera_new": (c_void_p, (c_char_p, _ERROR)),
    "arv_camera_get_device": (c_void_p, (c_void_p,)),
    "arv_camera_get_vendor_name": (c_char_p, (c_void_p, _ERROR)),
    "arv_camera_get_model_name": (c_char_p, (c_void_p, _ERROR)),
    "arv_camera_get_device_serial_number": (c_char_p, (c_void_p, _ERROR)),
    "arv_camera_is_gv_device": (c_int, (c_void_p,)),
    "arv_gv_device_is_controller": (c_int, (c_void_p,)),
    "arv_camera_is_feature_available": (c_int, (c_void_p, c_char_p, _ERROR)),
    "arv_camera_execute_command": (None, (c_void_p, c_char_p, _ERROR)),
    "arv_camera_get_integer": (c_int64, (c_void_p, c_char_p, _ERROR)),
    "arv_camera_get_integer_bounds": (None, (c_void_p, c_char_p, _LONG, _LONG, _ERROR)),
    "arv_camera_get_integer_increment": (c_int64, (c_void_p, c_char_p, _ERROR)),
    "arv_camera_dup_available_enumerations_as_strings": (_STRINGS, (c_void_p, c_char_p, POINTER(c_uint), _ERROR)),
    "arv_camera_get_exposure_time": (c_double, (c_void_p, _ERROR)),
    "arv_camera_set_exposure_time": (None, (c_void_p, c_double, _ERROR)),
    "arv_camera_get_exposure_time_bounds": (None, (c_void_p, _FLOAT, _FLOAT, _ERROR)),
    "arv_camera_get_gain": (c_double, (c_void_p, _ERROR)),
    "arv_camera_set_gain": (None, (c_void_p, c_double, _ERROR)),
    "arv_camera_get_gain_bounds": (None, (c_void_p, _FLOAT, _FLOAT, _ERROR)),
    "arv_camera_get_frame_rate": (c_double, (c_void_p, _ERROR)),
    "arv_camera_set_frame_rate": (None, (c_void_p, c_double, _ERROR)),
    "arv_camera_get_region": (None, (c_void_p, _INT, _INT, _INT, _INT, _ERROR)),
    "arv_camera_set_region": (None, (c_void_p, c_int, c_int, c_int, c_int, _ERROR)),
    "arv_camera_get_payload": (c_uint, (c_void_p, _ERROR)),
    "arv_camera_gv_set_stream_options": (None, (c_void_p, c_int)),
    "arv_camera_gv_auto_packet_size": (c_uint, (c_void_p, _ERROR)),
    "arv_camera_gv_set_packet_size": (None, (c_void_p, c_int, _ERROR)),
    "arv_camera_gv_get_packet_size": (c_uint, (c_void_p, _ERROR)),
    "arv_camera_start_acquisition": (None, (c_void_p, _ERROR)),
    "arv_camera_stop_acquisition": (None, (c_void_p, _ERROR)),
    "arv_camera_create_stream": (c_void_p, (c_void_p, c_void_p, c_void_p, _ERROR)),
    "arv_stream_push_buffer": (None, (c_void_p, c_void_p)),
    "arv_stream_timeout_pop_buffer": (c_void_p, (c_void_p, c_uint64)),
    "arv_buffer_new_allocate": (c_void_p, (c_size_t,)),
    "arv_buffer_get_status": (c_int, (c_void_p,)),
    "arv_buffer_get_frame_id": (c_uint64, (c_void_p,)),
    "arv_buffer_get_timestamp": (c_uint64, (c_void_p,)),
    "arv_buffer_get_system_timestamp": (c_uint64, (c_void_p,)),
    "arv_buffer_get_data": (c_void_p, (c_void_p, POINTER(c_size_t))),
    "arv_buffer_get_image_padding": (None, (c_void_p, _INT, _INT)),
    "g_error_free": (None, (c_void_p,)),
    "g_free": (None, (c_void_p,)),
    "g_object_unref": (None, (c_void_p,)),
    "g_object_set_property": (None, (c_void_p, c_char_p, POINTER(_Value))),
    "g_value_init": (c_void_p, (POINTER(_Value), c_size_t)),
    "g_value_set_int": (None, (POINTER(_Value), c_int)),
}

_SINCE_0_8_23: Final = frozenset({"arv_buffer_get_image_padding"})

# ArvDeviceError, by number in 0.8
_KINDS: Final[dict[int, type[DeviceError]]] = {
    0: Unsupported,  # wrong type of feature
    1: Unsupported,  # no such feature
    2: Disconnected,  # not connected
    5: Disconnected,  # no answer, after five attempts
    6: Disconnected,  # not found
    7: BadValue,  # invalid parameter
    10: Disconnected,  # control lost
    12: Unsupported,  # not implemented
    13: BadValue,  # invalid parameter, reported by the camera
    15: WrongState,  # write-protected
    17: WrongState,  # access denied
    18: WrongState,  # busy
}
# libusb errors in the message, for which Aravis has no code
_USB: Final[dict[str, type[DeviceError]]] = {
    "LIBUSB_ERROR_NO_DEVICE": Disconnected,
    "LIBUSB_ERROR_IO": Disconnected,
    "LIBUSB_ERROR_BUSY": Busy,
}


def kinds_of_errors(version: tuple[int, int]) -> dict[int, type[DeviceError]]:
    """Return the kind of device error of each ArvDeviceError; 0.9 inserted number 10, STREAM_ERROR."""
    if version < (0, 9):
        return _KINDS
    return {number + (number >= 10): kind for number, kind in _KINDS.items()}


class Aravis:
    """The loaded library."""

    def __init__(self) -> None:
        self._functions: dict[str, Any] = {}
        libraries = load_library()
        for name, (result, arguments) in _FUNCTIONS.items():
            found = [function for library in libraries if (function := getattr(library, name, None))]
            if found:
                self._functions[name] = found[0]
                found[0].restype, found[0].argtypes = result, arguments
            elif name not in _SINCE_0_8_23:
                raise Unsupported(f"the library Aravis is too old, it lacks {name}: 0.8.20 or later is needed")
        self._device_errors = self.call("arv_device_error_quark")
        version = (self.call("arv_get_major_version"), self.call("arv_get_minor_version"))
        self._kinds = kinds_of_errors(version)
        if version >= (0, 9):  # one argument more, a function that frees the data of the callback
            self._functions["arv_camera_create_stream"].argtypes = (*(c_void_p,) * 4, _ERROR)
        self._callback = (None,) * (2 if version < (0, 9) else 3)

    def has(self, name: str) -> bool:
        """True if this version of the library has the function."""
        return name in self._functions

    def call(self, name: str, *arguments: Any) -> Any:
        """Call a function by name, with text results as str; raise its error as a `DeviceError`."""
        if _FUNCTIONS[name][1][-1:] != (_ERROR,):
            return _text(self._functions[name](*arguments))
        error = POINTER(_Error)()
        result = self._functions[name](*arguments, ctypes.byref(error))
        if error:
            raise self._taken(error)
        return _text(result)

    def create_stream(self, camera: int) -> int:
        """Return a new stream of a camera."""
        return self.call("arv_camera_create_stream", camera, *self._callback) or 0

    def choices(self, camera: int, feature: str) -> tuple[str, ...]:
        """Return the present values of an enumeration of the camera."""
        count = c_uint()
        name = "arv_camera_dup_available_enumerations_as_strings"
        values = self.call(name, camera, feature.encode(), ctypes.byref(count))
        try:
            return tuple(_text(values[i]) for i in range(count.value))
        finally:
            self._functions["g_free"](values)

    def set_property(self, target: int, name: str, number: int) -> None:
        """Set an integer or enumeration property of a library object."""
        value = _Value()
        self._functions["g_value_init"](ctypes.byref(value), _G_TYPE_INT)
        self._functions["g_value_set_int"](ctypes.byref(value), number)
        self._functions["g_object_set_property"](target, name.encode(), ctypes.byref(value))

    def _taken(self, error: Any) -> DeviceError:
        """Convert a GError and free it."""
        domain, code, message = error.contents.domain, error.contents.code, _text(error.contents.message)
        self._functions["g_error_free"](error)
        kind = next((kind for word, kind in _USB.items() if word in message), None)
        if kind is None:
            kind = self._kinds.get(code, DeviceError) if domain == self._device_errors else DeviceError
        failure = "does not answer" if kind is Disconnected else "refuses the request"
        return kind(f"the camera {failure}: {message}")


@cache
def load_aravis() -> Aravis:
    """Return the library; raise `Unsupported`, with installation advice, if it is missing."""
    return Aravis()


def load_library() -> tuple[ctypes.CDLL, ...]:
    """Load Aravis, and on Windows what it depends on: there a library exports only its own functions."""
    if sys.platform == "win32":
        searched = map(ctypes.util.find_library, _SEARCHED_ON_WINDOWS)  # in PATH, unlike CDLL
        for path in filter(None, (*_packaged(), *searched)):
            prefix = Path(path).name.partition("aravis")[0]
            parts = (Path(path).with_name(f"{prefix}{part}-2.0-0.dll") for part in ("gobject", "glib"))
            with suppress(OSError):
                return (ctypes.CDLL(path), *(ctypes.CDLL(str(part)) for part in parts))
    for name in (*_NAMES.get(sys.platform, ()), *_SEARCHED):
        found = ctypes.util.find_library(name) if name in _SEARCHED else name
        with suppress(OSError):
            if found:
                return (ctypes.CDLL(found),)
    raise Unsupported(
        f"GenICam cameras need the library Aravis 0.8.20 or later, which is not installed: {HOW_TO_INSTALL}"
    )


def _packaged() -> list[str]:
    """Path of the library in the package aravis-python, without its import, which needs PyGObject."""
    package = importlib.util.find_spec("aravis")
    folders = (package and package.submodule_search_locations) or ()
    return [str(path) for folder in folders if (path := Path(folder, "bin", "aravis-0.8-0.dll")).exists()]


def _text(value: Any) -> Any:
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else value
