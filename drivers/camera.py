"""What every camera offers, and the rules that hold for all of them.

A driver fills in the methods with a leading underscore. They are called only when the device is open and not lost, with
values that lie in the capabilities, and in the state that they need.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Literal, Self

from drivers.device import Device, Property
from drivers.errors import BadValue, Disconnected, Unsupported, WrongState
from drivers.frame import Frame, Region, check_region
from drivers.range import Range

CameraState = Literal["stopped", "running", "lost", "closed"]


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraCapabilities:
    """What the camera allows in its present mode; read again after every change of mode."""

    rows: int  # of a frame, as it comes in the present region and binning
    columns: int
    pixel_pitch_m: float | None  # of a pixel of the frame, where the camera or its settings tell it
    full_scale: int  # the count at which a pixel saturates
    exposure_range_s: Range
    em_gain_range: Range
    amplifiers: tuple[str, ...]
    readout_speeds: tuple[int, ...] = (1,)  # from the slowest
    binnings: tuple[int, ...] = (1,)
    triggers: tuple[str, ...] = ("internal",)
    sensor: Region | None = None  # all of it, where a part of it can be read out; in steps of
    region_step_px: int = 1


class Camera(Device):
    """A camera that, once started, takes one frame after another until it is stopped.

    Every setter returns, or leaves to be asked, what the camera really took; a value that is refused leaves the one
    before. Amplifier, readout speed, binning, region and trigger are its mode: they can be changed only while it is
    stopped, and may move the exposure, the gain and what is allowed.
    """

    def __init__(self) -> None:
        super().__init__("camera")
        self._allowed: CameraCapabilities | None = None

    def properties(self) -> dict[str, Property]:
        """All settings in force; a driver adds what else its camera can tell."""
        region = self.region
        return {
            "name": self.name,
            "exposure_s": self.exposure_s,
            "em_gain": self.em_gain,
            "amplifier": self.amplifier,
            "readout_speed": self.readout_speed,
            "binning": self.binning,
            "trigger": self.trigger,
            "region": f"{region.rows} x {region.columns} at row {region.top}, column {region.left}",
        }

    @property
    def state(self) -> CameraState:
        """Whether it runs, and whether it is there at all; the one question that a lost camera answers."""
        if self._is_closed:
            return "closed"
        try:
            return "running" if self.is_running else "stopped"
        except Disconnected:
            return "lost"

    @property
    def capabilities(self) -> CameraCapabilities:
        """What is allowed in the present mode."""
        with self._talking():
            if self._allowed is None:
                self._allowed = self._read_capabilities()
            return self._allowed

    @property
    def exposure_s(self) -> float:
        """The exposure time in force."""
        with self._talking():
            return self._read_exposure()

    def set_exposure(self, exposure_s: float) -> float:
        """Change the exposure time, also while running; return the one in force."""
        self.capabilities.exposure_range_s.check(exposure_s, "exposure_s")
        with self._talking():
            return self._set_exposure(exposure_s)

    @property
    def em_gain(self) -> float:
        """The electron multiplication in force, 1 when there is none."""
        with self._talking():
            return self._read_em_gain()

    def set_em_gain(self, em_gain: float) -> float:
        """Change the electron multiplication, also while running; return the one in force."""
        self.capabilities.em_gain_range.check(em_gain, "em_gain")
        with self._talking():
            return self._set_em_gain(em_gain)

    @property
    def amplifier(self) -> str:
        """The amplifier in use, one of `capabilities.amplifiers`."""
        with self._talking():
            return self._read_amplifier()

    def set_amplifier(self, amplifier: str) -> None:
        """Change the amplifier; only while stopped."""
        self._check_mode(amplifier, self.capabilities.amplifiers, "amplifier")
        with self._changing_mode():
            self._set_amplifier(amplifier)

    @property
    def readout_speed(self) -> int:
        """The readout speed in use, one of `capabilities.readout_speeds`."""
        with self._talking():
            return self._read_readout_speed()

    def set_readout_speed(self, readout_speed: int) -> None:
        """Change the readout speed; only while stopped."""
        self._check_mode(readout_speed, self.capabilities.readout_speeds, "readout speed")
        with self._changing_mode():
            self._set_readout_speed(readout_speed)

    @property
    def binning(self) -> int:
        """How many pixels of the sensor, along both axes, make one of the frame."""
        with self._talking():
            return self._read_binning()

    def set_binning(self, binning: int) -> None:
        """Change the binning; only while stopped."""
        self._check_mode(binning, self.capabilities.binnings, "binning")
        with self._changing_mode():
            self._set_binning(binning)

    @property
    def trigger(self) -> str:
        """What starts an exposure, one of `capabilities.triggers`."""
        with self._talking():
            return self._read_trigger()

    def set_trigger(self, trigger: str) -> None:
        """Change what starts an exposure; only while stopped."""
        self._check_mode(trigger, self.capabilities.triggers, "trigger")
        with self._changing_mode():
            self._set_trigger(trigger)

    @property
    def region(self) -> Region:
        """The part of the sensor that is read out."""
        with self._talking():
            return self._read_region()

    def set_region(self, region: Region) -> Region:
        """Read out another part of the sensor; only while stopped. Return the one in force."""
        allowed = self.capabilities
        if allowed.sensor is None:
            raise Unsupported("this camera always reads out its whole sensor")
        check_region(region, allowed.sensor, allowed.region_step_px)
        self._check_stopped("region")
        with self._changing_mode():
            return self._set_region(region)

    @property
    def is_running(self) -> bool:
        """Whether frames are being taken."""
        with self._talking():
            return self._is_running()

    def start(self) -> None:
        """Begin to take frames, counted from 0."""
        if self.is_running:
            raise WrongState("the camera is running already")
        with self._talking():
            self._start()

    def stop(self) -> None:
        """Stop taking frames; those not yet read are gone. Stopping twice is allowed."""
        if self.is_running:
            with self._talking():
                self._stop()

    @contextmanager
    def paused(self) -> Iterator[Self]:
        """Stop a running camera for a `with` block and restart it afterwards, also when the block fails.

        A camera that is lost or closed by then stays so; one that was stopped is not started.
        """
        was_running = self.is_running
        self.stop()
        try:
            yield self
        finally:
            if was_running and self.state == "stopped":
                self.start()

    def read(self, timeout_s: float) -> Frame:
        """Return the oldest frame not yet read, waiting at most `timeout_s`, else raise `DeviceTimeout`.

        Frames that the camera had to overwrite before they were read show as a gap in `Frame.index`. `FrameLost` is
        raised for one that came damaged; its number is then missing, too.
        """
        if not self.is_running:
            raise WrongState("the camera must be started before a frame can be read")
        if not 0 <= timeout_s < float("inf"):
            raise BadValue(f"timeout_s = {timeout_s:g} must be 0 or positive, and finite")
        with self._talking():
            return self._read(timeout_s)

    @contextmanager
    def _changing_mode(self) -> Iterator[None]:
        """Speak to the camera; what it allows is read again afterwards, also when it refused half-way."""
        with self._talking():
            try:
                yield
            finally:
                self._allowed = None

    def _check_mode(self, value: object, allowed: tuple[object, ...], what: str) -> None:
        if value not in allowed:
            raise BadValue(f"there is no {what} {value!r}; there are {', '.join(map(str, allowed))}")
        self._check_stopped(what)

    def _check_stopped(self, what: str) -> None:
        if self.is_running:
            raise WrongState(f"the {what} can be changed only while the camera is stopped")

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

    # What not every camera can choose. Where there is a choice in the capabilities, the driver has both methods.

    def _read_em_gain(self) -> float:
        return 1.0

    def _set_em_gain(self, em_gain: float) -> float:
        return em_gain

    def _read_amplifier(self) -> str:
        return self.capabilities.amplifiers[0]

    def _set_amplifier(self, amplifier: str) -> None:
        """Nothing to do where there is one."""

    def _read_readout_speed(self) -> int:
        return self.capabilities.readout_speeds[0]

    def _set_readout_speed(self, readout_speed: int) -> None:
        """Nothing to do where there is one."""

    def _read_binning(self) -> int:
        return self.capabilities.binnings[0]

    def _set_binning(self, binning: int) -> None:
        """Nothing to do where there is one."""

    def _read_trigger(self) -> str:
        return self.capabilities.triggers[0]

    def _set_trigger(self, trigger: str) -> None:
        """Nothing to do where there is one."""

    def _read_region(self) -> Region:
        allowed = self.capabilities
        return Region(0, 0, allowed.rows, allowed.columns)

    def _set_region(self, region: Region) -> Region:
        return region
