"""Translation of DCAM-API error codes to device errors."""

from __future__ import annotations

from drivers.errors import (
    BadValue,
    Busy,
    DeviceError,
    DeviceTimeout,
    Disconnected,
    FrameLost,
    Unsupported,
    WrongState,
)


class NotThere(Unsupported):
    """The camera has no such property, or no next one."""


_GONE = "the camera is gone: check its power and cable, then connect again"
_NOT_NOW = "the camera cannot do this in its present state"
_TAKEN = "the camera cannot be opened: another program holds it (close it), or the camera is switched off"
_NO_DRIVER = "Hamamatsu's driver for the camera's interface is missing or damaged: install the DCAM-API again"
_NO_CAMERA = "no Hamamatsu camera was found: check its power and cable, and that no other program holds it"
_DAMAGED = "a frame was lost or damaged in transfer"
_REFUSED = "the camera refused the value"
_NOT_THERE = "this camera cannot do this, or not in its present mode"

# Codes as in Hamamatsu's header, unsigned; the library returns them as negative numbers.
ERRORS: dict[int, tuple[str, type[DeviceError], str]] = {
    0x80000101: ("BUSY", WrongState, _NOT_NOW),
    0x80000102: ("ABORT", WrongState, "the wait for a frame was aborted"),
    0x80000103: ("NOTREADY", WrongState, _NOT_NOW),
    0x80000104: ("NOTSTABLE", WrongState, _NOT_NOW),
    0x80000105: ("UNSTABLE", WrongState, _NOT_NOW),
    0x80000106: ("TIMEOUT", DeviceTimeout, "the camera did not answer in time"),
    0x80000107: ("NOTBUSY", WrongState, _NOT_NOW),
    0x80000110: ("EXCLUDED", Busy, _TAKEN),
    0x80000201: ("NORESOURCE", DeviceError, "the computer lacks a resource that the camera needs"),
    0x80000203: ("NOMEMORY", DeviceError, "the computer lacks memory for the frames: lower camera.ring_frames"),
    0x80000204: ("NOMODULE", Unsupported, _NO_DRIVER),
    0x80000205: ("NODRIVER", Unsupported, _NO_DRIVER),
    0x80000206: ("NOCAMERA", Disconnected, _NO_CAMERA),
    0x80000207: ("NOGRABBER", Unsupported, "the frame grabber of the camera is missing, or its driver"),
    0x80000211: ("INVALIDMODULE", Unsupported, _NO_DRIVER),
    0x80000301: ("LOSTFRAME", FrameLost, _DAMAGED),
    0x80000302: ("COOLINGTROUBLE", DeviceError, "the camera's cooling fails: check its fan or water"),
    0x80000303: ("NOTRIGGER", DeviceTimeout, "no trigger reached the camera"),
    0x80000304: ("TEMPERATURE_TROUBLE", DeviceError, "the camera warns of its temperature: check its cooling"),
    0x80000305: ("TOOFREQUENTTRIGGER", FrameLost, "triggers come faster than the camera can take frames"),
    0x80000321: ("INVALIDIMAGE", FrameLost, _DAMAGED),
    0x80000806: ("INVALIDCAMERA", Disconnected, _GONE),
    0x80000807: ("INVALIDHANDLE", Disconnected, _GONE),
    0x80000808: ("INVALIDPARAM", BadValue, _REFUSED),
    0x80000821: ("INVALIDVALUE", BadValue, _REFUSED),
    0x80000822: ("OUTOFRANGE", BadValue, _REFUSED),
    0x80000823: ("NOTWRITABLE", Unsupported, _NOT_THERE),
    0x80000824: ("NOTREADABLE", Unsupported, _NOT_THERE),
    0x80000825: ("INVALIDPROPERTYID", NotThere, _NOT_THERE),
    0x80000828: ("NOPROPERTY", NotThere, _NOT_THERE),
    0x8000082B: ("INVALIDSUBARRAY", BadValue, "the camera refused the region"),
    0x8000082C: ("ACCESSDENY", WrongState, _NOT_NOW),
    0x80000833: ("INVALIDFRAMEINDEX", FrameLost, _DAMAGED),
    0x80000F01: ("UNREACH", Disconnected, _GONE),
    0x80000F02: ("NOTIMPLEMENT", Unsupported, _NOT_THERE),
    0x80000F03: ("NOTSUPPORT", Unsupported, _NOT_THERE),
    0x80000F04: ("UNLOADED", Disconnected, "Hamamatsu's DCAM-API has ended: connect again"),
    0x80000F06: ("MISSINGFRAME_TROUBLE", FrameLost, _DAMAGED),
    0x80000F07: ("NOCONNECTION", Disconnected, _GONE),
    0x81001001: ("FAILOPENBUS", Busy, _TAKEN),
    0x82001001: ("FAILOPENCAMERA", Busy, _TAKEN),
    0x83001002: ("FAILREADCAMERA", Disconnected, _GONE),
    0x83001003: ("FAILWRITECAMERA", Disconnected, _GONE),
    0x84002001: ("INVALIDWAITHANDLE", Disconnected, _GONE),
}


def error_of(code: int, what: str) -> DeviceError:
    """Return the error for a code, signed or not, that `what` returned."""
    unsigned = code & 0xFFFFFFFF
    name, kind, sentence = ERRORS.get(unsigned, ("unknown", DeviceError, "the camera reports an error"))
    return kind(f"{sentence} ({what}: {name}, {unsigned:08x})")
