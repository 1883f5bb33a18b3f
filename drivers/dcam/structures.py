"""Structures of the DCAM-API 4, laid out for 64-bit pointers."""

from __future__ import annotations

from ctypes import Structure, c_char_p, c_double, c_int32, c_uint32, c_void_p, sizeof
from typing import Any, ClassVar, TypeAlias, TypeVar

Fields: TypeAlias = list[tuple[str, Any]]
S = TypeVar("S", bound=Structure)


def sized(kind: type[S], **values: Any) -> S:
    """Return a structure whose first member is its own size, as every call requires."""
    made = kind(**values)
    setattr(made, made._fields_[0][0], sizeof(kind))
    return made


def _int32(*names: str) -> Fields:
    return [(name, c_int32) for name in names]


class Init(Structure):
    """For dcamapi_init."""

    _fields_: ClassVar[Fields] = [
        *_int32("size", "iDeviceCount", "reserved", "initoptionbytes"),
        ("initoption", c_void_p),
        ("guid", c_void_p),
    ]


class DeviceOpen(Structure):
    """For dcamdev_open."""

    _fields_: ClassVar[Fields] = [*_int32("size", "index"), ("hdcam", c_void_p)]


class DeviceString(Structure):
    """For dcamdev_getstring."""

    _fields_: ClassVar[Fields] = [*_int32("size", "iString"), ("text", c_char_p), *_int32("textbytes")]


class PropertyAttribute(Structure):
    """For dcamprop_getattr."""

    _fields_: ClassVar[Fields] = [
        *_int32("cbSize", "iProp", "option", "iReserved1", "attribute", "iGroup", "iUnit", "attribute2"),
        *[(name, c_double) for name in ("valuemin", "valuemax", "valuestep", "valuedefault")],
        *_int32("nMaxChannel", "iReserved3", "nMaxView"),
        *_int32("iProp_NumberOfElement", "iProp_ArrayBase", "iPropStep_Element"),
    ]


class PropertyValueText(Structure):
    """For dcamprop_getvaluetext."""

    _fields_: ClassVar[Fields] = [
        *_int32("cbSize", "iProp"),
        ("value", c_double),
        ("text", c_char_p),
        *_int32("textbytes"),
    ]


class TimeStamp(Structure):
    """Time of a frame on the camera's clock."""

    _fields_: ClassVar[Fields] = [("sec", c_uint32), ("microsec", c_int32)]


class TransferInfo(Structure):
    """For dcamcap_transferinfo."""

    _fields_: ClassVar[Fields] = _int32("size", "iKind", "nNewestFrameIndex", "nFrameCount")


class BufferFrame(Structure):
    """For dcambuf_copyframe."""

    _fields_: ClassVar[Fields] = [
        *_int32("size", "iKind", "option", "iFrame"),
        ("buf", c_void_p),
        *_int32("rowbytes", "type", "width", "height", "left", "top"),
        ("timestamp", TimeStamp),
        *_int32("framestamp", "camerastamp"),
    ]


class WaitOpen(Structure):
    """For dcamwait_open."""

    _fields_: ClassVar[Fields] = [*_int32("size", "supportevent"), ("hwait", c_void_p), ("hdcam", c_void_p)]


class WaitStart(Structure):
    """For dcamwait_start."""

    _fields_: ClassVar[Fields] = _int32("size", "eventhappened", "eventmask", "timeout")
