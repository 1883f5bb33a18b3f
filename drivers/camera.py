"""The camera interface with its frames, and the rules common to all cameras.

A driver implements the methods with a leading underscore. They are called only while the device is open and connected,
with values within the capabilities, and in the state that they need.
"""

import math
from abc import abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Self, TypeAlias, TypeVar

import numpy as np
from annotated_types import Gt, Le
from numpy.typing import NDArray
from typing_extensions import Doc

from drivers.device import Device, Property, Range
from drivers.errors import BadValue, Disconnected, Unsupported, WrongState

CameraState = Literal["stopped", "running", "lost", "closed"]
Mode = TypeVar("Mode", int, str)

INTERNAL = "internal"  # the trigger of a camera that runs freely
NOT_STARTED = "the camera must be started before a frame can be read"
CLOSING = "the camera is being closed"
NO_FRAME = "no frame came in time"
STOPPED = "the camera has stopped taking frames on its own; start it again"
GONE = "the camera is gone: check its power and cable, then connect again"
NO_MEMORY = "the computer lacks memory for the frames: lower camera.ring_frames"


@dataclass(frozen=True, slots=True)
class Region:
    """Part of the sensor that is read out, in unbinned pixels."""

    top: int
    left: int
    rows: int
    columns: int


# Settings that the real cameras share.
PitchSetting: TypeAlias = Annotated[
    float, Gt(0), Le(1e-3), Doc("Pixel pitch of the sensor, if the camera does not report it")
]
ExposureSetting: TypeAlias = Annotated[float, Gt(0), Le(86_400)]
RegionSetting: TypeAlias = Annotated[Region, Doc("Part of the sensor that is read out; omitted: the whole sensor")]


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Frame:
    """One exposure with its metadata."""

    pixels: NDArray[np.uint16]  # (row, column), counts; read-only, not shared
    index: int  # the camera's frame number since start, from 0; a gap is a lost frame
    camera_time_s: float  # end of the exposure on the camera's clock
    host_time_s: float  # time.perf_counter() after the frame arrived
    exposure_s: float
    em_gain: float  # 1 without electron multiplication


class SettingsInForce:
    """Exposure (s) and gain of each frame of a run, by its index or end; cameras do not report them."""

    def __init__(self, exposure_s: float, em_gain: float) -> None:
        self._changes = [(-math.inf, exposure_s, em_gain)]  # first frame, exposure, gain

    def change(self, first: float, exposure_s: float, em_gain: float) -> None:
        """Record what holds from this frame on."""
        self._changes.append((first, exposure_s, em_gain))

    def of_frame(self, frame: float) -> tuple[float, float]:
        """Return exposure and gain of a frame; later calls are for later frames, or the oldest left."""
        newest = max((place for place, (first, _, _) in enumerate(self._changes) if first <= frame), default=0)
        del self._changes[:newest]
        return self._changes[0][1:]

    @property
    def newest(self) -> tuple[float, float]:
        """Exposure and gain of the newest change."""
        return self._changes[-1][1:]


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraCapabilities:
    """Allowed settings in the present mode; read again after every change of mode."""

    rows: int  # of a frame, in the present region and binning
    columns: int
    pixel_pitch_m: float | None  # of a pixel of the frame; None if unknown
    full_scale: int  # the count at which a pixel saturates
    exposure_range_s: Range
    em_gain_range: Range = Range(1.0, 1.0)
    amplifiers: tuple[str, ...] = ("normal",)
    readout_speeds: tuple[int, ...] = (1,)  # slowest first
    binnings: tuple[int, ...] = (1,)
    triggers: tuple[str, ...] = (INTERNAL,)
    sensor: Region | None = None  # the whole sensor; None if no region can be chosen
    region_step_px: int = 1


class Camera(Device):
    """A camera that takes frames continuously between `start` and `stop`.

    A refused value leaves the previous one in force. Amplifier, readout speed, binning, region and trigger are the
    mode: they change only while the camera is stopped, and may change exposure, gain and capabilities.
    """

    def __init__(self) -> None:
        super().__init__("camera")
        self._cached_capabilities: CameraCapabilities | None = None  # cache for the present mode

    def properties(self) -> dict[str, Property]:
        """All settings in force; drivers add what else their camera reports."""
        region = self.region
        plain = ("name", "exposure_s", "em_gain", "amplifier", "readout_speed", "binning", "trigger")
        return {key: getattr(self, key) for key in plain} | {
            "region": f"{region.rows} x {region.columns} at row {region.top}, column {region.left}"
        }

    @property
    def state(self) -> CameraState:
        """Connection and acquisition state; the only query that a lost or closed camera answers."""
        if self._is_closed:
            return "closed"
        try:
            return "running" if self.is_running else "stopped"
        except Disconnected:
            return "lost"

    @property
    def capabilities(self) -> CameraCapabilities:
        """Allowed settings in the present mode."""
        with self._access():
            if (known := self._cached_capabilities) is None:
                self._cached_capabilities = known = self._read_capabilities()
            return known

    @property
    def exposure_s(self) -> float:
        """Exposure time in force."""
        with self._access():
            return self._read_exposure()

    def set_exposure(self, exposure_s: float) -> float:
        """Change the exposure time, also while running; return the one in force."""
        self.capabilities.exposure_range_s.check(exposure_s, "exposure_s")
        with self._access():
            return self._set_exposure(exposure_s)

    @property
    def em_gain(self) -> float:
        """Electron multiplication in force; 1 without any."""
        with self._access():
            return self._read_em_gain()

    def set_em_gain(self, em_gain: float) -> float:
        """Change the electron multiplication, also while running; return the one in force."""
        self.capabilities.em_gain_range.check(em_gain, "em_gain")
        with self._access():
            return self._set_em_gain(em_gain)

    @property
    def amplifier(self) -> str:
        """Amplifier in use, one of `capabilities.amplifiers`."""
        with self._access():
            return self._read_amplifier()

    def set_amplifier(self, amplifier: str) -> None:
        """Change the amplifier; only while stopped."""
        self._set_mode("amplifier", amplifier, self.capabilities.amplifiers, self._set_amplifier)

    @property
    def readout_speed(self) -> int:
        """Readout speed in use, one of `capabilities.readout_speeds`."""
        with self._access():
            return self._read_readout_speed()

    def set_readout_speed(self, readout_speed: int) -> None:
        """Change the readout speed; only while stopped."""
        self._set_mode("readout speed", readout_speed, self.capabilities.readout_speeds, self._set_readout_speed)

    @property
    def temperature_c(self) -> float | None:
        """Temperature of the sensor; None if the camera does not report it."""
        with self._access():
            return self._read_temperature()

    @property
    def binning(self) -> int:
        """Sensor pixels per frame pixel along each axis."""
        with self._access():
            return self._read_binning()

    def set_binning(self, binning: int) -> None:
        """Change the binning; only while stopped."""
        self._set_mode("binning", binning, self.capabilities.binnings, self._set_binning)

    @property
    def trigger(self) -> str:
        """Source that starts an exposure, one of `capabilities.triggers`."""
        with self._access():
            return self._read_trigger()

    def set_trigger(self, trigger: str) -> None:
        """Change the trigger; only while stopped."""
        self._set_mode("trigger", trigger, self.capabilities.triggers, self._set_trigger)

    @property
    def region(self) -> Region:
        """Part of the sensor that is read out."""
        with self._access():
            return self._read_region()

    def set_region(self, region: Region) -> Region:
        """Change the region; only while stopped. Return the one in force."""
        allowed = self.capabilities
        if allowed.sensor is None:
            raise Unsupported("this camera always reads out its whole sensor")
        check_region(region, allowed.sensor, allowed.region_step_px)
        self._check_stopped("region")
        with self._changing_mode():
            return self._set_region(region)

    @property
    def is_running(self) -> bool:
        """True between `start` and `stop`."""
        with self._access():
            return self._is_running()

    def start(self) -> None:
        """Begin to take frames, counted from 0."""
        if self.is_running:
            raise WrongState("the camera is running already")
        with self._access():
            self._start()

    def stop(self) -> None:
        """Stop taking frames and discard the unread ones. Stopping twice is allowed."""
        if self.is_running:
            with self._access():
                self._stop()

    @contextmanager
    def paused(self) -> Iterator[Self]:
        """Stop a running camera for a `with` block, and restart it also after an error, unless it is lost or closed."""
        was_running = self.is_running
        self.stop()
        try:
            yield self
        finally:
            if was_running and self.state == "stopped":
                self.start()

    def read(self, timeout_s: float) -> Frame:
        """Return the oldest unread frame.

        A frame that the camera overwrote before it was read shows as a gap in `Frame.index`.

        Raises
        ------
        DeviceTimeout
            No frame came within `timeout_s`.
        FrameLost
            A frame arrived damaged; its index is missing, too.
        """
        if not self.is_running:
            raise WrongState(NOT_STARTED)
        if not 0 <= timeout_s < float("inf"):
            raise BadValue(f"timeout_s = {timeout_s:g} must be 0 or positive, and finite")
        with self._access():
            return self._read(timeout_s)

    @contextmanager
    def _changing_mode(self) -> Iterator[None]:
        """Access the camera and then drop the cached capabilities, also after a refusal."""
        with self._access():
            try:
                yield
            finally:
                self._cached_capabilities = None

    def _set_mode(self, what: str, value: Mode, allowed: tuple[Mode, ...], write: Callable[[Mode], None]) -> None:
        if value not in allowed:
            raise BadValue(f"there is no {what} {value!r}; there are {', '.join(map(str, allowed))}")
        self._check_stopped(what)
        with self._changing_mode():
            write(value)

    def _check_stopped(self, what: str) -> None:
        if self.is_running:
            raise WrongState(f"the {what} can be changed only while the camera is stopped")

    def _apply(self, **settings: Any) -> None:
        """Apply settings in their order; None leaves the camera's value."""
        for name, value in settings.items():
            if value is not None:
                getattr(self, f"set_{name}")(value)

    @abstractmethod
    def _read_capabilities(self) -> CameraCapabilities: ...

    @abstractmethod
    def _is_running(self) -> bool: ...

    @abstractmethod
    def _start(self) -> None: ...

    @abstractmethod
    def _stop(self) -> None: ...

    @abstractmethod
    def _read(self, timeout_s: float) -> Frame: ...

    @abstractmethod
    def _read_exposure(self) -> float: ...

    @abstractmethod
    def _set_exposure(self, exposure_s: float) -> float: ...

    # Optional settings: a driver overrides both methods of each setting that its capabilities offer.

    def _read_em_gain(self) -> float:
        return 1.0

    def _set_em_gain(self, em_gain: float) -> float:
        return em_gain

    def _read_amplifier(self) -> str:
        return self.capabilities.amplifiers[0]

    def _set_amplifier(self, amplifier: str) -> None: ...

    def _read_temperature(self) -> float | None:
        return None

    def _read_readout_speed(self) -> int:
        return self.capabilities.readout_speeds[0]

    def _set_readout_speed(self, readout_speed: int) -> None: ...

    def _read_binning(self) -> int:
        return self.capabilities.binnings[0]

    def _set_binning(self, binning: int) -> None: ...

    def _read_trigger(self) -> str:
        return self.capabilities.triggers[0]

    def _set_trigger(self, trigger: str) -> None: ...

    def _read_region(self) -> Region:
        allowed = self.capabilities
        return Region(0, 0, allowed.rows, allowed.columns)

    def _set_region(self, region: Region) -> Region:
        return region


def check_region(region: Region, sensor: Region, step_px: int) -> None:
    """Raise `BadValue` unless the region is the whole sensor, or lies on it in whole steps."""
    if region == sensor:
        return
    sides = ((region.top, region.rows, sensor.rows), (region.left, region.columns, sensor.columns))
    is_on_sensor = all(0 <= start < start + length <= whole for start, length, whole in sides)
    if not is_on_sensor or any(start % step_px or length % step_px for start, length, _ in sides):
        raise BadValue(
            f"a region of {region.rows} x {region.columns} pixels at row {region.top}, column {region.left} does not"
            f" lie on the sensor of {sensor.rows} x {sensor.columns} in steps of {step_px}"
        )
