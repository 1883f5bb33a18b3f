"""Hamamatsu cameras behind the DCAM-API: the C9100-23B, and others with the same properties.

Limits and modes are queried after each change of mode; nothing about a camera is tabulated here.
"""

import math
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from ctypes import byref

from drivers.camera import NOT_STARTED, Camera, CameraCapabilities, Frame, Region
from drivers.dcam import DcamSettings
from drivers.dcam import _property_ids as ids
from drivers.dcam import _session as session
from drivers.dcam._capabilities import (
    AMPLIFIERS,
    FILTERS,
    TRIGGERS,
    has_em_gain,
    pixel_warnings,
    read_capabilities,
    read_region,
    set_region,
)
from drivers.dcam._capture import Capture
from drivers.dcam._library import DcamLibrary, DeviceOpen, load_library, sized
from drivers.dcam._properties import Properties
from drivers.dcam._property_ids import Id
from drivers.device import DiscoveredDevice, Property
from drivers.errors import REFUSALS, DeviceError, Unsupported, WrongState, attempt

# A running camera may deny reading these.
_MODE = (
    *(Id.CCDMODE, Id.READOUTSPEED, Id.BINNING, Id.TRIGGERSOURCE, Id.TRIGGERACTIVE, *FILTERS),
    *(Id.SUBARRAYMODE, Id.SUBARRAYHPOS, Id.SUBARRAYHSIZE, Id.SUBARRAYVPOS, Id.SUBARRAYVSIZE),
)


def discover(library: DcamLibrary | None = None) -> tuple[DiscoveredDevice, ...]:
    """Return the connected cameras; raise `Unsupported` if Hamamatsu's library is missing."""
    return tuple(
        DiscoveredDevice(
            kind="camera", driver="dcam", description=camera.name, settings={"device": camera.serial_number}
        )
        for camera in session.connected(library or load_library())
    )


class DcamCamera(Camera):
    """An open camera; `clock` gives the host time of frames and measures timeouts."""

    def __init__(
        self, settings: DcamSettings, library: DcamLibrary | None = None, clock: Callable[[], float] = time.perf_counter
    ) -> None:
        super().__init__()
        self._settings = settings
        self._library = library or load_library(settings.library)
        self._clock = clock
        self._capture: Capture | None = None  # while running
        self._unreleased: Capture | None = None  # not yet released by a failed start or stop
        with ExitStack() as undo:
            cameras = session.begin(self._library)
            undo.callback(self._try, session.end, self._library)
            camera = session.chosen(self._library, cameras, settings.device)
            self._name = camera.name
            opened = sized(DeviceOpen, index=camera.index)
            self._library.call("dcamdev_open", byref(opened))
            self._handle: int = opened.hdcam
            undo.callback(self._try, self._library.call, "dcamdev_close", self._handle)
            self._values = Properties(self._library, self._handle)
            self._set_up(settings)
            self._undo = undo.pop_all()

    def properties(self) -> dict[str, Property]:
        """All settings, every DCAM property by Hamamatsu's name, and warnings."""
        common = super().properties()
        with self._access():
            strings: dict[str, Property] = {}
            for name, number in session.STRINGS.items():
                with suppress(*REFUSALS):  # not all cameras have all of them
                    strings[name] = session.string(self._library, self._handle, number)
            return common | strings | self._values.readable() | {"warnings": "; ".join(self.warnings())}

    def warnings(self) -> tuple[str, ...]:
        """Settings and states in which the pixels are not proportional to photons, in words."""
        with self._access():
            return pixel_warnings(self._values, has_em_gain=has_em_gain(self._values))

    def _set_up(self, settings: DcamSettings) -> None:
        self._take_16_bits()
        self._apply(amplifier=settings.amplifier)
        with self._access():
            if has_em_gain(self._values):
                self._prepare_em_gain()
        self._apply(readout_speed=settings.readout_speed, binning=settings.binning)
        self._apply(region=settings.region or self.capabilities.sensor)
        self._reset_trigger()
        self._apply(trigger=settings.trigger, exposure=settings.exposure_s, em_gain=settings.em_gain)
        with self._access():
            for identifier, value in _simple_settings(settings).items():
                if value is not None:
                    self._values.set(identifier, value)

    def _take_16_bits(self) -> None:
        """Set the pixel type, if another program left a smaller one."""
        if self._values.get_or(Id.IMAGE_PIXELTYPE, ids.PIXELTYPE_MONO16) != ids.PIXELTYPE_MONO16:
            try:
                self._values.set(Id.IMAGE_PIXELTYPE, ids.PIXELTYPE_MONO16)
            except REFUSALS as error:
                raise Unsupported("only cameras that give one 16-bit number per pixel can be used") from error

    def _reset_trigger(self) -> None:
        """Reset what another program left: waiting for a first pulse, several pulses per frame, global reset."""
        usual = {Id.TRIGGER_MODE: 1, Id.TRIGGERTIMES: 1, Id.TRIGGER_GLOBALEXPOSURE: ids.GLOBALEXPOSURE_DELAYED}
        with self._access():
            for identifier, value in usual.items():
                if self._values.get_or(identifier, value) > value:
                    self._values.set(identifier, value)

    def _close(self) -> None:
        capture = self._capture  # a reader in another thread may end it meanwhile
        if capture is not None:
            capture.abort()
        with self._lock:  # after that reader
            self._try(self._stop)
            self._try(self._release_ring)
            self._undo.close()

    @staticmethod
    def _try(step: Callable[..., object], *arguments: object) -> None:
        """Take a step of closing, ignoring a failure."""
        with suppress(DeviceError):
            step(*arguments)

    def _read_capabilities(self) -> CameraCapabilities:
        return read_capabilities(self._values, self._settings.pixel_pitch_m)

    def _prepare_em_gain(self) -> None:
        """Select the true EM gain scale, if available, and the register protection."""
        if self._values.get_or(Id.DIRECTEMGAIN_MODE, ids.ON) != ids.ON:
            self._values.set(Id.DIRECTEMGAIN_MODE, ids.ON)
        self._values.set_if_present(Id.EMGAINPROTECT_MODE, ids.ON if self._settings.em_gain_protection else ids.OFF)

    @contextmanager
    def _changing_mode(self) -> Iterator[None]:
        """Release the ring first, which blocks changes of mode."""
        with super()._changing_mode():
            self._release_ring()
            try:
                yield
            finally:
                self._values.forget_list()

    @contextmanager
    def _restored_on_failure(self, identifier: Id) -> Iterator[None]:
        """Restore the former value after a failure at any step."""
        before = self._values.get(identifier)
        try:
            yield
        except DeviceError:
            self._try(self._values.set, identifier, before)
            raise

    def _read_exposure(self) -> float:
        return self._values.get(Id.EXPOSURETIME)

    def _set_exposure(self, exposure_s: float) -> float:
        with self._restored_on_failure(Id.EXPOSURETIME):
            taken_s = self._values.set(Id.EXPOSURETIME, exposure_s)
            if self._capture is not None:
                self._capture.change(taken_s, self._read_em_gain())
        return taken_s

    def _read_temperature(self) -> float | None:
        temperature_c = self._values.get_or(Id.SENSORTEMPERATURE, math.nan)
        return None if math.isnan(temperature_c) else temperature_c

    def _read_em_gain(self) -> float:
        return self._values.get(Id.SENSITIVITY) if has_em_gain(self._values) else 1.0

    def _set_em_gain(self, em_gain: float) -> float:
        if not has_em_gain(self._values):
            return 1.0
        with self._restored_on_failure(Id.SENSITIVITY):
            taken = self._values.set(Id.SENSITIVITY, em_gain)
            if self._capture is not None:
                self._capture.change(self._read_exposure(), taken)
        return taken

    def _read_amplifier(self) -> str:
        return AMPLIFIERS[round(self._values.get_or(Id.CCDMODE, ids.CCDMODE_NORMAL))]

    def _set_amplifier(self, amplifier: str) -> None:
        if amplifier == self._read_amplifier():  # setting it again would reset the camera to its defaults
            return
        with self._restored_on_failure(Id.CCDMODE):
            self._values.set(Id.CCDMODE, ids.CCDMODE_EM if amplifier == "em" else ids.CCDMODE_NORMAL)
            self._values.forget_list()  # the other amplifier has other properties
            if amplifier == "em":
                self._prepare_em_gain()

    def _read_readout_speed(self) -> int:
        return round(self._values.get_or(Id.READOUTSPEED, 1))

    def _set_readout_speed(self, readout_speed: int) -> None:
        self._values.set_if_present(Id.READOUTSPEED, readout_speed)

    def _read_binning(self) -> int:
        return round(self._values.get_or(Id.BINNING, 1))

    def _set_binning(self, binning: int) -> None:
        self._values.set_if_present(Id.BINNING, binning)

    def _read_trigger(self) -> str:
        return TRIGGERS.get(round(self._values.get_or(Id.TRIGGERSOURCE, 1)), "internal")

    def _set_trigger(self, trigger: str) -> None:
        self._values.set_if_present(Id.TRIGGERSOURCE, ids.TRIGGER_SOURCES[trigger])

    def _read_region(self) -> Region:
        whole = self.capabilities.sensor
        return super()._read_region() if whole is None else read_region(self._values, whole)

    def _set_region(self, region: Region) -> Region:
        whole = self.capabilities.sensor
        return region if whole is None else set_region(self._values, region, whole)

    def _is_running(self) -> bool:
        return self._capture is not None

    def _start(self) -> None:
        self._release_ring()
        allowed = self.capabilities
        self._values.remember(_MODE)
        capture = Capture(
            self._values,
            (allowed.rows, allowed.columns),
            self._settings.ring_frames,
            (self._read_exposure(), self._read_em_gain()),
            self._clock,
            trigger=self._read_trigger(),
        )
        try:
            capture.begin()
        except DeviceError:
            self._unreleased = capture
            self._try(self._release_ring)
            raise
        self._capture = capture

    def _stop(self) -> None:
        if self._capture is None:
            return
        self._capture.stop()
        self._capture, self._unreleased = None, self._capture
        self._values.check_online()  # a running camera may deny it
        attempt(self._release_ring)  # if it fails, it is tried again before the next use

    def _release_ring(self) -> None:
        if self._unreleased is not None:
            self._unreleased.end()
            self._unreleased = None

    def _read(self, timeout_s: float) -> Frame:
        if self._capture is None:
            raise WrongState(NOT_STARTED)
        try:
            frame = self._capture.read(timeout_s)
        except WrongState:
            self._try(self._stop)
            raise
        if not frame.pixels[0].any() and not frame.pixels.any() and self._is_protected():
            raise DeviceError(
                "the camera protects its EM register from too much light and sends black frames:"
                " lower the light or the EM gain, then stop and start it"
            )
        return frame

    def _is_protected(self) -> bool:
        protected = ids.EMGAINWARNING_PROTECTED  # also if the running camera denies its status: the frame is black
        has_status = has_em_gain(self._values) and self._values.has(Id.EMGAINWARNING_STATUS)
        return has_status and self._values.get_or(Id.EMGAINWARNING_STATUS, protected) == protected


def _simple_settings(settings: DcamSettings) -> dict[Id, float | None]:
    """Independent properties; None leaves the camera's value."""
    return {
        Id.TRIGGERACTIVE: ids.TRIGGER_ACTIVE.get(settings.trigger_active or ""),
        Id.TRIGGERPOLARITY: ids.POLARITIES.get(settings.trigger_polarity or ""),
        Id.TRIGGERDELAY: settings.trigger_delay_s,
        Id.OUTPUTTRIGGER_KIND: ids.OUTPUTS.get(settings.output or ""),
        Id.OUTPUTTRIGGER_POLARITY: ids.POLARITIES.get(settings.output_polarity or ""),
        Id.SENSORCOOLER: ids.COOLER.get(settings.cooler or ""),
        Id.EMGAINPROTECT_AFTERFRAMES: settings.em_gain_protection_frames,
        Id.EMGAINWARNING_LEVEL: settings.em_gain_warning_level,
    }
