"""What every camera, light and stage offers, whoever made it: all that the rest of the program sees of a device.

Units are SI (s, A, m). A setter returns the value that the device really took, which may be rounded. Only one
thread calls a device. Every fault that a device can have leaves it as one of the `DeviceError` family.
"""

from __future__ import annotations

from drivers.camera import Camera, CameraCapabilities, CameraState
from drivers.device import Device, Property
from drivers.devices import Devices
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
from drivers.frame import Frame, Region
from drivers.light_source import LightSource
from drivers.range import Range
from drivers.stage import Stage

__all__ = [
    "BadValue",
    "Busy",
    "Camera",
    "CameraCapabilities",
    "CameraState",
    "Device",
    "DeviceError",
    "DeviceTimeout",
    "Devices",
    "Disconnected",
    "Frame",
    "FrameLost",
    "LightSource",
    "Property",
    "Range",
    "Region",
    "Stage",
    "Unsupported",
    "WrongState",
]
