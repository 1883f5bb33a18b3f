"""The device interface: all that the rest of the program sees of a camera, light or stage.

Units are SI (s, A, m). A setter returns the value in force, which the device may have rounded. One thread calls a
device. Every fault of a device is raised as a `DeviceError`.
"""

from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Self

from drivers.camera import NO_FRAME, Camera, CameraCapabilities, CameraState, Frame, Region
from drivers.device import Device, Property, Range, switched
from drivers.errors import (
    REFUSALS,
    BadValue,
    Busy,
    DeviceError,
    DeviceTimeout,
    Disconnected,
    FrameLost,
    LightHeldOff,
    Unsupported,
    WrongState,
)
from drivers.light_source import LightSource, OffCount
from drivers.stage import Stage


@dataclass(frozen=True, slots=True, eq=False)
class Devices:
    """The open devices of one bench; `close` turns the light off first."""

    camera: Camera
    light: LightSource
    stage: Stage
    _closing: ExitStack = field(default_factory=ExitStack)

    def close(self) -> None:
        """Close all of them, each even if another fails."""
        self._closing.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
