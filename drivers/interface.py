"""What every camera, light and stage offers, whoever made it: all that the rest of the program sees of a device.

Units are SI (s, A, m). A setter returns the value that the device really took, which may be rounded. Only one
thread calls a device. Every fault that a device can have leaves it as one of the `DeviceError` family below.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import NDArray


class DeviceError(Exception):
    """A device could not do what it was asked to; the text is one sentence for the person at the bench."""


class Disconnected(DeviceError):
    """The device is gone: unplugged, switched off or taken by another program."""


class DeviceTimeout(DeviceError):
    """The device did not answer, or no frame came, within the time that was allowed."""


class WrongState(DeviceError):
    """The device cannot do this now, for example read a frame before it was started."""


class BadValue(DeviceError):
    """A setting outside what the device allows; the text says what is allowed."""


@dataclass(frozen=True, slots=True)
class Range:
    """A closed interval of allowed values, in the unit of the setting it belongs to."""

    minimum: float
    maximum: float

    def check(self, value: float, what: str) -> float:
        """Return `value` if it lies in the interval, else raise `BadValue` naming `what` and the interval."""
        if not self.minimum <= value <= self.maximum:  # false for NaN, too
            raise BadValue(f"{what} = {value:g} is outside {self.minimum:g} ... {self.maximum:g}")
        return value


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One exposure, as it left the camera."""

    pixels: NDArray[np.uint16]  # (row, column), counts; read-only, owned by the receiver
    index: int  # the camera's own count of frames since start; a gap is a lost frame
    camera_time_s: float  # end of the exposure on the camera's clock
    host_time_s: float  # time.perf_counter() when the frame had arrived here
    exposure_s: float
    em_gain: float  # 1 without electron multiplication


@dataclass(frozen=True, slots=True)
class CameraCapabilities:
    """What the camera allows in its present mode; read again after every change of amplifier."""

    rows: int
    columns: int
    pixel_pitch_m: float
    full_scale: int  # the count at which a pixel saturates
    exposure_range_s: Range
    amplifiers: tuple[str, ...]
    em_gain_range: Range


class _Closing(ABC):
    """Anything that must be closed, also as a context manager."""

    @abstractmethod
    def close(self) -> None:
        """Leave the device safe and let go of it; closing twice is allowed."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class Camera(_Closing):
    """A camera that, once started, takes one frame after another until it is stopped."""

    @property
    @abstractmethod
    def name(self) -> str:
        """Maker, model and serial number, as a person would say them."""

    @property
    @abstractmethod
    def capabilities(self) -> CameraCapabilities:
        """What is allowed in the present mode."""

    @property
    @abstractmethod
    def exposure_s(self) -> float:
        """The exposure time in force."""

    @abstractmethod
    def set_exposure(self, exposure_s: float) -> float:
        """Change the exposure time, also while running; return the one in force."""

    @property
    @abstractmethod
    def amplifier(self) -> str:
        """The amplifier in use, one of `capabilities.amplifiers`."""

    @abstractmethod
    def set_amplifier(self, amplifier: str) -> None:
        """Change the amplifier; only while stopped. The exposure is moved into the new range if it must be."""

    @property
    @abstractmethod
    def em_gain(self) -> float:
        """The electron multiplication in force, 1 when there is none."""

    @abstractmethod
    def set_em_gain(self, em_gain: float) -> float:
        """Change the electron multiplication, also while running; return the one in force."""

    @property
    @abstractmethod
    def is_running(self) -> bool:
        """Whether frames are being taken."""

    @abstractmethod
    def start(self) -> None:
        """Begin to take frames, counted from 0."""

    @abstractmethod
    def stop(self) -> None:
        """Stop taking frames; stopping twice is allowed."""

    @abstractmethod
    def read(self, timeout_s: float) -> Frame:
        """Return the oldest frame not yet read, waiting at most `timeout_s`, else raise `DeviceTimeout`.

        Frames that the camera had to overwrite before they were read show as a gap in `Frame.index`.
        """


class LightSource(_Closing):
    """A light with an adjustable current. It is off after it was opened and after it was closed."""

    @property
    @abstractmethod
    def name(self) -> str:
        """Maker, model and serial number, as a person would say them."""

    @property
    @abstractmethod
    def current_range_a(self) -> Range:
        """The currents that driver and head allow."""

    @property
    @abstractmethod
    def current_a(self) -> float:
        """The current that flows when the light is on."""

    @abstractmethod
    def set_current(self, current_a: float) -> float:
        """Change the current; return the one in force."""

    @property
    @abstractmethod
    def is_on(self) -> bool:
        """Whether the light is lit."""

    @abstractmethod
    def set_on(self, on: bool) -> None:
        """Switch the light."""


class Stage(_Closing):
    """What moves the sample in and out of the beam and changes the mask in front of the light."""

    @property
    @abstractmethod
    def masks(self) -> tuple[str, ...]:
        """The masks that can be put in, for example ("square", "stars")."""

    @property
    @abstractmethod
    def mask(self) -> str:
        """The mask that is in."""

    @abstractmethod
    def set_mask(self, mask: str) -> None:
        """Put another mask in."""

    @property
    @abstractmethod
    def is_sample_in(self) -> bool:
        """Whether the sample is in the beam."""

    @abstractmethod
    def set_sample_in(self, sample_in: bool) -> None:
        """Move the sample into or out of the beam."""
