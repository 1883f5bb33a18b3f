"""Hamamatsu cameras behind the DCAM-API: the C9100-23B, and others with the same properties.

Limits and modes are queried after each change of mode; nothing about a camera is tabulated here.
"""

import math
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from ctypes import byref
from time import perf_counter

from drivers.camera import INTERNAL, NOT_STARTED, Camera, CameraCapabilities, Frame, Region
from drivers.dcam import DcamSettings
from drivers.dcam import _properties as ids
from drivers.dcam._capture import Capture
from drivers.dcam._library import STRINGS, DcamLibrary, DeviceOpen, load_library, sized
from drivers.dcam._properties import Id, Properties
from drivers.device import DiscoveredDevice, Property, Range
from drivers.errors import REFUSALS, DeviceError, Unsupported, WrongState, attempt, undone_if_refused

_SQUARE = 100  # larger numbers of a binning are oblong: 102 is 1 x 2
# A running camera may deny reading these.
_MODE = (
    *(Id.CCDMODE, Id.READOUTSPEED, Id.BINNING, Id.TRIGGERSOURCE, Id.TRIGGERACTIVE, *ids.FILTERS),
    *(Id.SUBARRAYMODE, Id.SUBARRAYHPOS, Id.SUBARRAYHSIZE, Id.SUBARRAYVPOS, Id.SUBARRAYVSIZE),
)


def discover(library: DcamLibrary | None = None) -> tuple[DiscoveredDevice, ...]:
    """Return the connected cameras; raise `Unsupported` if Hamamatsu's library is missing."""
    return tuple(
        DiscoveredDevice(
            kind="camera", driver="dcam", description=camera.name, settings={"device": camera.serial_number}
        )
        for camera in (library or load_library()).connected()
    )


class DcamCamera(Camera):
    """An open camera; `clock` gives the host time of frames and measures timeouts."""

    def __init__(
        self, settings: DcamSettings, *, library: DcamLibrary | None = None, clock: Callable[[], float] = perf_counter
    ) -> None:
        super().__init__()
        self._settings = settings
        self._library = library or load_library(settings.library)
        self._clock = clock
        self._capture: Capture | None = None  # while running
        self._unreleased: Capture | None = None  # not yet released by a failed start or stop
        with ExitStack() as undo:
            cameras = self._library.begin()
            undo.callback(self._try, self._library.end)
            camera = self._library.chosen(cameras, settings.device)
            self._name = camera.name
            opened = sized(DeviceOpen, index=camera.index)
            self._library.call("dcamdev_open", byref(opened))
            self._handle: int = opened.hdcam
            undo.callback(self._try, self._library.call, "dcamdev_close", self._handle)
            self._properties = Properties(self._library, self._handle)
            self._set_up(settings)
            self._undo = undo.pop_all()

    def properties(self) -> dict[str, Property]:
        """All settings, every DCAM property by Hamamatsu's name, and warnings."""
        common = super().properties()
        with self._access():
            strings: dict[str, Property] = {}
            for name, number in STRINGS.items():
                with suppress(*REFUSALS):  # not all cameras have all of them
                    strings[name] = self._library.string(self._handle, number)
            return common | strings | self._properties.readable() | {"warnings": "; ".join(self.warnings())}

    def warnings(self) -> tuple[str, ...]:
        """Settings and states in which the pixels are not proportional to photons, in words."""
        with self._access():
            properties, has_em_gain = self._properties, self._has_em_gain()
            harmful = (
                key for key, (harmless, _) in ids.FILTERS.items() if properties.get_or(key, harmless) != harmless
            )
            warnings = [ids.FILTERS[key][1] for key in harmful]
            triggered = properties.get_or(Id.TRIGGERSOURCE, 1) == ids.TRIGGER_SOURCES["external"]
            if triggered and properties.get_or(Id.TRIGGERACTIVE, 1) != ids.TRIGGER_ACTIVE["edge"]:
                warnings.append("the trigger pulses determine the exposure, not the set time")
            if has_em_gain and properties.get_or(Id.DIRECTEMGAIN_MODE, ids.OFF) != ids.ON:
                warnings.append("the EM gain is a number on the camera's own scale, not the true multiplication")
            match properties.get_or(Id.EMGAINWARNING_STATUS, 1) if has_em_gain else 1:
                case ids.EMGAINWARNING_WARNING:
                    warnings.append("too much light for this EM gain: it ages the multiplication register")
                case ids.EMGAINWARNING_PROTECTED:
                    warnings.append("the camera protects its EM register from too much light: its frames are black")
            cooler = properties.get_or(Id.SENSORCOOLERSTATUS, 0)
            if cooler < 0 or cooler == ids.COOLERSTATUS_WARNING:
                temperature = properties.get(Id.SENSORTEMPERATURE)
                warnings.append(f"the sensor's cooler reports a fault at {temperature:g} degC: dark current is high")
            return tuple(warnings)

    def _set_up(self, settings: DcamSettings) -> None:
        self._take_16_bits()
        self._apply(amplifier=settings.amplifier)
        with self._access():
            if self._has_em_gain():
                self._prepare_em_gain()
        self._apply(readout_speed=settings.readout_speed, binning=settings.binning)
        self._apply(region=settings.region or self.capabilities.sensor)
        self._reset_trigger()
        self._apply(trigger=settings.trigger, exposure=settings.exposure_s, em_gain=settings.em_gain)
        with self._access():
            for identifier, value in _simple_settings(settings).items():
                if value is not None:
                    self._properties.set(identifier, value)

    def _take_16_bits(self) -> None:
        """Set the pixel type, if another program left a smaller one."""
        if self._properties.get_or(Id.IMAGE_PIXELTYPE, ids.PIXELTYPE_MONO16) != ids.PIXELTYPE_MONO16:
            try:
                self._properties.set(Id.IMAGE_PIXELTYPE, ids.PIXELTYPE_MONO16)
            except REFUSALS as error:
                raise Unsupported("only cameras that give one 16-bit number per pixel can be used") from error

    def _reset_trigger(self) -> None:
        """Reset what another program left: waiting for a first pulse, several pulses per frame, global reset."""
        usual = {Id.TRIGGER_MODE: 1, Id.TRIGGERTIMES: 1, Id.TRIGGER_GLOBALEXPOSURE: ids.GLOBALEXPOSURE_DELAYED}
        with self._access():
            for identifier, value in usual.items():
                if self._properties.get_or(identifier, value) > value:
                    self._properties.set(identifier, value)

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
        properties = self._properties
        whole, step_px = self._sensor()
        speeds = properties.limits(Id.READOUTSPEED).range if properties.has(Id.READOUTSPEED) else Range(1, 1)
        triggers = properties.values(Id.TRIGGERSOURCE)
        return CameraCapabilities(
            rows=round(properties.get(Id.IMAGE_HEIGHT)),
            columns=round(properties.get(Id.IMAGE_WIDTH)),
            pixel_pitch_m=self._pixel_pitch_m() * self._read_binning(),
            full_scale=2 ** round(properties.get(Id.BITSPERCHANNEL)) - 1,
            exposure_range_s=properties.limits(Id.EXPOSURETIME).range,
            em_gain_range=properties.limits(Id.SENSITIVITY).range if self._has_em_gain() else Range(1.0, 1.0),
            amplifiers=tuple(ids.AMPLIFIERS[mode] for mode in properties.values(Id.CCDMODE) if mode in ids.AMPLIFIERS),
            readout_speeds=tuple(range(round(speeds.minimum), round(speeds.maximum) + 1)),
            binnings=tuple(mode for mode in properties.values(Id.BINNING) if mode < _SQUARE),
            triggers=tuple(ids.TRIGGERS[mode] for mode in triggers if mode in ids.TRIGGERS),
            sensor=whole,
            region_step_px=step_px,
        )

    def _has_em_gain(self) -> bool:
        """True if the amplifier in use multiplies electrons."""
        return self._properties.get_or(Id.CCDMODE, ids.CCDMODE_NORMAL) == ids.CCDMODE_EM

    def _pixel_pitch_m(self) -> float:
        pitch_m = self._settings.pixel_pitch_m or 1e-6 * self._properties.get_or(Id.IMAGEDETECTOR_PIXELWIDTH, 0.0)
        if not pitch_m:
            raise Unsupported("this camera does not report its pixel pitch: set camera.pixel_pitch_m")
        return pitch_m

    def _sensor(self) -> tuple[Region | None, int]:
        """Return the whole sensor, None if it has no subarrays, and their step in pixels."""
        if not self._properties.has(Id.SUBARRAYMODE):
            return None, 1
        rows, columns, top, left = map(self._properties.limits, (*ids.SUBARRAY_SIZE, *ids.SUBARRAY_POSITION))
        step_px = math.lcm(*(max(1, round(limits.step)) for limits in (rows, columns, top, left)))
        return Region(0, 0, round(rows.range.maximum), round(columns.range.maximum)), step_px

    def _prepare_em_gain(self) -> None:
        """Select the true EM gain scale, if available, and the register protection."""
        if self._properties.get_or(Id.DIRECTEMGAIN_MODE, ids.ON) != ids.ON:
            self._properties.set(Id.DIRECTEMGAIN_MODE, ids.ON)
        self._properties.set_if_present(Id.EMGAINPROTECT_MODE, ids.ON if self._settings.em_gain_protection else ids.OFF)

    @contextmanager
    def _changing_mode(self) -> Iterator[None]:
        """Release the ring first, which blocks changes of mode."""
        with super()._changing_mode():
            self._release_ring()
            try:
                yield
            finally:
                self._properties.forget_list()

    @contextmanager
    def _restored_on_failure(self, identifier: Id) -> Iterator[None]:
        """Restore the former value after a failure at any step."""
        before = self._properties.get(identifier)
        try:
            yield
        except DeviceError:
            self._try(self._properties.set, identifier, before)
            raise

    def _read_exposure(self) -> float:
        return self._properties.get(Id.EXPOSURETIME)

    def _set_exposure(self, exposure_s: float) -> float:
        return self._set_of_frames(Id.EXPOSURETIME, exposure_s)

    def _set_of_frames(self, identifier: Id, value: float) -> float:
        """Change exposure or EM gain, and note which frames have it; return the one in force."""
        with self._restored_on_failure(identifier):
            taken = self._properties.set(identifier, value)
            if self._capture is not None:
                self._capture.change(self._read_exposure(), self._read_em_gain())
        return taken

    def _read_temperature(self) -> float | None:
        temperature_c = self._properties.get_or(Id.SENSORTEMPERATURE, math.nan)
        return None if math.isnan(temperature_c) else temperature_c

    def _read_em_gain(self) -> float:
        return self._properties.get(Id.SENSITIVITY) if self._has_em_gain() else 1.0

    def _set_em_gain(self, em_gain: float) -> float:
        return self._set_of_frames(Id.SENSITIVITY, em_gain) if self._has_em_gain() else 1.0

    def _read_amplifier(self) -> str:
        return ids.AMPLIFIERS[round(self._properties.get_or(Id.CCDMODE, ids.CCDMODE_NORMAL))]

    def _set_amplifier(self, amplifier: str) -> None:
        if amplifier == self._read_amplifier():  # setting it again would reset the camera to its defaults
            return
        with self._restored_on_failure(Id.CCDMODE):
            self._properties.set(Id.CCDMODE, ids.CCDMODE_EM if amplifier == "em" else ids.CCDMODE_NORMAL)
            self._properties.forget_list()  # the other amplifier has other properties
            if amplifier == "em":
                self._prepare_em_gain()

    def _read_readout_speed(self) -> int:
        return round(self._properties.get_or(Id.READOUTSPEED, 1))

    def _set_readout_speed(self, readout_speed: int) -> None:
        self._properties.set_if_present(Id.READOUTSPEED, readout_speed)

    def _read_binning(self) -> int:
        return round(self._properties.get_or(Id.BINNING, 1))

    def _set_binning(self, binning: int) -> None:
        self._properties.set_if_present(Id.BINNING, binning)

    def _read_trigger(self) -> str:
        return ids.TRIGGERS.get(round(self._properties.get_or(Id.TRIGGERSOURCE, 1)), INTERNAL)

    def _set_trigger(self, trigger: str) -> None:
        self._properties.set_if_present(Id.TRIGGERSOURCE, ids.TRIGGER_SOURCES[trigger])

    def _read_region(self) -> Region:
        whole = self.capabilities.sensor
        if whole is None:
            return super()._read_region()
        if self._properties.get(Id.SUBARRAYMODE) != ids.ON:
            return whole
        return Region(*(round(self._properties.get(each)) for each in (*ids.SUBARRAY_POSITION, *ids.SUBARRAY_SIZE)))

    def _set_region(self, region: Region) -> Region:
        before = self._read_region()
        with undone_if_refused(lambda: self._write_region(before)):
            self._write_region(region)
        return self._read_region()

    def _write_region(self, region: Region) -> None:
        """Write position 0, size, position, so that the region lies on the sensor at every step."""
        properties = self._properties
        properties.set(Id.SUBARRAYMODE, ids.OFF)
        if region == self.capabilities.sensor:
            return
        for position, size, start_px, length_px in (
            (Id.SUBARRAYHPOS, Id.SUBARRAYHSIZE, region.left, region.columns),
            (Id.SUBARRAYVPOS, Id.SUBARRAYVSIZE, region.top, region.rows),
        ):
            properties.set(position, 0)
            properties.set(size, length_px)
            properties.set(position, start_px)
        properties.set(Id.SUBARRAYMODE, ids.ON)

    def _is_running(self) -> bool:
        return self._capture is not None

    def _start(self) -> None:
        self._release_ring()
        allowed = self.capabilities
        self._properties.remember(_MODE)
        capture = Capture(
            self._properties,
            shape=(allowed.rows, allowed.columns),
            in_force=(self._read_exposure(), self._read_em_gain()),
            clock=self._clock,
            trigger=self._read_trigger(),
        )
        try:
            capture.begin(self._settings.ring_frames)
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
        self._properties.check_online()  # a running camera may deny it
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
        has_status = self._has_em_gain() and self._properties.has(Id.EMGAINWARNING_STATUS)
        return has_status and self._properties.get_or(Id.EMGAINWARNING_STATUS, protected) == protected


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
