"""Every fault that a device can have leaves it as one of this family; the text is one sentence for the bench."""

from __future__ import annotations


class DeviceError(Exception):
    """A device could not do what it was asked to."""


class Disconnected(DeviceError):
    """The device is gone: unplugged or switched off; it stays so until it is opened again."""


class Busy(DeviceError):
    """Another program holds the device."""


class DeviceTimeout(DeviceError):
    """The device did not answer, or no frame came, within the time that was allowed."""


class FrameLost(DeviceError):
    """A frame was damaged or lost on its way; the next one may be read."""


class WrongState(DeviceError):
    """The device cannot do this now, for example read a frame before it was started."""


class BadValue(DeviceError):
    """A setting outside what the device allows; the text says what is allowed."""


class Unsupported(DeviceError):
    """The device, or what it runs with, cannot do it at all."""
