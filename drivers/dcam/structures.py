"""Structures of the DCAM-API 4, laid out for 64-bit pointers."""

from ctypes import Structure, c_char_p, c_double, c_int32, c_uint32, c_void_p, sizeof
from typing import Any


def sized(kind: type[Structure], **values: Any) -> Structure:
    """Return a structure whose first member is its own size, as every call requires."""
    made = kind(**values)
    setattr(made, made._fields_[0][0], sizeof(kind))
    return made


def _int32(names: str) -> list[tuple[str, Any]]:
    return [(name, c_int32) for name in names.split()]


def _structure(name: str, *fields: tuple[str, Any]) -> type[Structure]:
    return type(name, (Structure,), {"_fields_": fields})


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
