"""Translation of DCAM-API error codes to device errors."""

from __future__ import annotations

from drivers.errors import BadValue, Busy, DeviceError, DeviceTimeout, Disconnected, FrameLost, Unsupported, WrongState


class NotThere(Unsupported):
    """The camera has no such property, or no next one."""


# Error, message, and the codes (unsigned) and names in Hamamatsu's header; the library returns negative numbers.
_GROUPS: tuple[tuple[type[DeviceError], str, dict[int, str]], ...] = (
    (
        WrongState,
        "the camera cannot do this in its present state",
        {
            0x80000101: "BUSY",
            0x80000103: "NOTREADY",
            0x80000104: "NOTSTABLE",
            0x80000105: "UNSTABLE",
            0x80000107: "NOTBUSY",
            0x8000082C: "ACCESSDENY",
        },
    ),
    (WrongState, "the wait for a frame was aborted", {0x80000102: "ABORT"}),
    (DeviceTimeout, "the camera did not answer in time", {0x80000106: "TIMEOUT"}),
    (
        Busy,
        "the camera cannot be opened: another program holds it (close it), or the camera is switched off",
        {0x80000110: "EXCLUDED", 0x81001001: "FAILOPENBUS", 0x82001001: "FAILOPENCAMERA"},
    ),
    (DeviceError, "the computer lacks a resource that the camera needs", {0x80000201: "NORESOURCE"}),
    (DeviceError, "the computer lacks memory for the frames: lower camera.ring_frames", {0x80000203: "NOMEMORY"}),
    (
        Unsupported,
        "Hamamatsu's driver for the camera's interface is missing or damaged: install the DCAM-API again",
        {0x80000204: "NOMODULE", 0x80000205: "NODRIVER", 0x80000211: "INVALIDMODULE"},
    ),
    (
        Disconnected,
        "no Hamamatsu camera was found: check its power and cable, and that no other program holds it",
        {0x80000206: "NOCAMERA"},
    ),
    (Unsupported, "the frame grabber of the camera is missing, or its driver", {0x80000207: "NOGRABBER"}),
    (
        FrameLost,
        "a frame was lost or damaged in transfer",
        {
            0x80000301: "LOSTFRAME",
            0x80000321: "INVALIDIMAGE",
            0x80000833: "INVALIDFRAMEINDEX",
            0x80000F06: "MISSINGFRAME_TROUBLE",
        },
    ),
    (DeviceError, "the camera's cooling fails: check its fan or water", {0x80000302: "COOLINGTROUBLE"}),
    (DeviceTimeout, "no trigger reached the camera", {0x80000303: "NOTRIGGER"}),
    (DeviceError, "the camera warns of its temperature: check its cooling", {0x80000304: "TEMPERATURE_TROUBLE"}),
    (FrameLost, "triggers come faster than the camera can take frames", {0x80000305: "TOOFREQUENTTRIGGER"}),
    (
        Disconnected,
        "the camera is gone: check its power and cable, then connect again",
        {
            0x80000806: "INVALIDCAMERA",
            0x80000807: "INVALIDHANDLE",
            0x80000F01: "UNREACH",
            0x80000F07: "NOCONNECTION",
            0x83001002: "FAILREADCAMERA",
            0x83001003: "FAILWRITECAMERA",
            0x84002001: "INVALIDWAITHANDLE",
        },
    ),
    (
        BadValue,
        "the camera refused the value",
        {0x80000808: "INVALIDPARAM", 0x80000821: "INVALIDVALUE", 0x80000822: "OUTOFRANGE"},
    ),
    (
        Unsupported,
        "this camera cannot do this, or not in its present mode",
        {0x80000823: "NOTWRITABLE", 0x80000824: "NOTREADABLE", 0x80000F02: "NOTIMPLEMENT", 0x80000F03: "NOTSUPPORT"},
    ),
    (
        NotThere,
        "this camera cannot do this, or not in its present mode",
        {0x80000825: "INVALIDPROPERTYID", 0x80000828: "NOPROPERTY"},
    ),
    (BadValue, "the camera refused the region", {0x8000082B: "INVALIDSUBARRAY"}),
    (Disconnected, "Hamamatsu's DCAM-API has ended: connect again", {0x80000F04: "UNLOADED"}),
)
ERRORS = {code: (name, kind, message) for kind, message, names in _GROUPS for code, name in names.items()}


def error_of(code: int, what: str) -> DeviceError:
    """Return the error for a code, signed or not, that `what` returned."""
    unsigned = code & 0xFFFFFFFF
    name, kind, message = ERRORS.get(unsigned, ("unknown", DeviceError, "the camera reports an error"))
    return kind(f"{message} ({what}: {name}, {unsigned:08x})")
