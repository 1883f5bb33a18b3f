"""Translation of DCAM-API error codes to device errors."""

from drivers.errors import BadValue, Busy, DeviceError, DeviceTimeout, Disconnected, FrameLost, Unsupported, WrongState


class NotThere(Unsupported):
    """The camera has no such property, or no next one."""


class Denied(WrongState):
    """A busy camera does not allow access to this property."""


# Error, message, and the codes (unsigned) with their names in Hamamatsu's header; the library returns negative numbers.
_TABLE: tuple[tuple[type[DeviceError], str, str], ...] = (
    (
        WrongState,
        "the camera cannot do this in its present state",
        "80000101 BUSY, 80000103 NOTREADY, 80000104 NOTSTABLE, 80000105 UNSTABLE, 80000107 NOTBUSY",
    ),
    (Denied, "a running camera does not allow this: stop it first", "8000082C ACCESSDENY"),
    (WrongState, "the wait for a frame was aborted", "80000102 ABORT"),
    (DeviceTimeout, "the camera did not answer in time", "80000106 TIMEOUT"),
    (
        Busy,
        "the camera cannot be opened: another program holds it (close it), or the camera is switched off",
        "80000110 EXCLUDED, 81001001 FAILOPENBUS, 82001001 FAILOPENCAMERA",
    ),
    (DeviceError, "the computer lacks a resource that the camera needs", "80000201 NORESOURCE"),
    (
        DeviceError,
        "the computer lacks memory for the frames: lower camera.ring_frames",
        "80000203 NOMEMORY, 8000083F LESSSYSTEMMEMORY",
    ),
    (
        Unsupported,
        "Hamamatsu's driver for the camera's interface is missing or damaged: install the DCAM-API again",
        "80000204 NOMODULE, 80000205 NODRIVER, 80000211 INVALIDMODULE",
    ),
    (Unsupported, "the camera needs a newer DCAM-API: install it from Hamamatsu", "84002002 NEWRUNTIMEREQUIRED"),
    (
        Disconnected,
        "no Hamamatsu camera was found: check its power and cable, and that no other program holds it",
        "80000206 NOCAMERA",
    ),
    (Unsupported, "the frame grabber of the camera is missing, or its driver", "80000207 NOGRABBER"),
    (
        FrameLost,
        "a frame was lost or damaged in transfer",
        "80000301 LOSTFRAME, 80000321 INVALIDIMAGE, 80000833 INVALIDFRAMEINDEX, 80000F06 MISSINGFRAME_TROUBLE",
    ),
    (DeviceError, "the camera's cooling fails: check its fan or water", "80000302 COOLINGTROUBLE"),
    (DeviceTimeout, "no trigger reached the camera", "80000303 NOTRIGGER"),
    (DeviceError, "the camera warns of its temperature: check its cooling", "80000304 TEMPERATURE_TROUBLE"),
    (FrameLost, "triggers come faster than the camera can take frames", "80000305 TOOFREQUENTTRIGGER"),
    (
        Disconnected,
        "the camera is gone: check its power and cable, then connect again",
        """80000806 INVALIDCAMERA, 80000807 INVALIDHANDLE, 80000F01 UNREACH, 80000F07 NOCONNECTION,
        83001002 FAILREADCAMERA, 83001003 FAILWRITECAMERA, 84002001 INVALIDWAITHANDLE""",
    ),
    (
        BadValue,
        "the camera refused the value",
        """80000808 INVALIDPARAM, 80000821 INVALIDVALUE, 80000822 OUTOFRANGE,
        8000082E WRONGPROPERTYVALUE""",
    ),
    (
        Unsupported,
        "this camera cannot do this, or not in its present mode",
        "80000823 NOTWRITABLE, 80000824 NOTREADABLE, 80000F02 NOTIMPLEMENT, 80000F03 NOTSUPPORT",
    ),
    (
        NotThere,
        "this camera cannot do this, or not in its present mode",
        "80000825 INVALIDPROPERTYID, 80000828 NOPROPERTY",
    ),
    (BadValue, "the camera refused the region", "8000082B INVALIDSUBARRAY"),
    (
        Unsupported,
        "frame bundling must be off: switch it off in Hamamatsu's program",
        "80000832 FRAMEBUNDLESHOULDBEOFF",
    ),
    (Disconnected, "Hamamatsu's DCAM-API has ended: connect again", "80000F04 UNLOADED"),
)
ERRORS = {
    int(code, 16): (name, kind, message)
    for kind, message, codes in _TABLE
    for code, name in (pair.split() for pair in codes.split(","))
}


def error_of(code: int, what: str) -> DeviceError:
    """Return the error for a code, signed or not, that `what` returned."""
    unsigned = code & 0xFFFFFFFF
    name, kind, message = ERRORS.get(unsigned, ("unknown", DeviceError, "the camera reports an error"))
    return kind(f"{message} ({what}: {name}, {unsigned:08x})")
