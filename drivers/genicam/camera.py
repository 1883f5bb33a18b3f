"""GigE Vision and USB3 Vision cameras over Aravis.

The camera numbers the frames: lost packets and missing buffers show as gaps. The analogue gain is a separate setting,
and the EM gain is 1. Not yet tried on a real camera; the tests use Aravis's fake camera, over UDP.
"""

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from ctypes import byref, c_size_t
from typing import Final

from drivers.camera import Camera, CameraCapabilities
from drivers.device import Property
from drivers.errors import BadValue, DeviceError, DeviceTimeout, Disconnected, FrameLost, Unsupported, WrongState
from drivers.frame import Frame, Region
from drivers.genicam.connection import GenicamConnection
from drivers.genicam.discovery import choose
from drivers.genicam.frames import PIXEL_FORMATS, ExposureLog, FrameCount, copied_pixels
from drivers.genicam.library import STATUS_SUCCESS, load_aravis
from drivers.genicam.settings import GenicamSettings
from drivers.range import Range

_SLICE_S: Final = 0.1  # longest wait for a frame between two checks of the connection
_LARGEST_BINNING: Final = 64
_INTERNAL: Final = "internal"
# properties, if the camera has them
_PROPERTIES_AS_TEXT: Final = ("DeviceVersion", "DeviceFirmwareVersion", "DeviceUserID")
_PROPERTIES_AS_NUMBER: Final = ("DeviceTemperature", "BlackLevel")


class GenicamCamera(Camera):
    """An open GenICam camera."""

    def __init__(self, settings: GenicamSettings | None = None) -> None:
        super().__init__()
        self._settings = settings = settings or GenicamSettings()
        self._aravis = load_aravis()
        device = choose(settings.device)
        self._line = GenicamConnection(self._aravis, device, settings)
        self._count = FrameCount()
        self._exposures = ExposureLog.beginning_with(0.0)
        self._incomplete = 0
        self._asked_region: Region | None = None  # may be no multiple of the binning
        try:
            details = ("vendor_name", "model_name", "device_serial_number")
            self._name = " ".join(filter(None, (self._line.call(f"arv_camera_get_{detail}") for detail in details)))
            with suppress(BadValue, Unsupported, WrongState):  # a stopped camera may refuse
                self._line.call("arv_camera_execute_command", b"AcquisitionStop")
            self._format = PIXEL_FORMATS[self._choose_pixel_format()]
            self._prepare()
        except BaseException:
            self._line.close()
            raise

    def properties(self) -> dict[str, Property]:
        """All settings in force and further details for the record."""
        line = self._line
        details = super().properties()
        with self._access():
            details["protocol"] = "GigE Vision" if line.is_gige else "USB3 Vision"
            details["pixel_format"] = f"Mono{self._format.bits}"
            if line.call("arv_camera_is_gain_available"):
                details["gain"] = line.call("arv_camera_get_gain")
            if line.call("arv_camera_is_frame_rate_available"):
                details["frame_rate_hz"] = line.call("arv_camera_get_frame_rate")
            if line.is_gige:
                details["packet_size"] = line.call("arv_camera_gv_get_packet_size")
            details |= {name: line.text(name) for name in _PROPERTIES_AS_TEXT if line.has(name)}
            details |= {name: line.number(name) for name in _PROPERTIES_AS_NUMBER if line.has(name)}
        return details | {"incomplete_frames": self._incomplete}

    def _close(self) -> None:
        try:
            if self._line.is_streaming and not self._loss:
                self._stop()
        finally:
            self._line.close()

    def _choose_pixel_format(self) -> str:
        """Set and return the format of the settings, or the deepest available."""
        offered = self._line.choices("PixelFormat")
        usable = [name for name in PIXEL_FORMATS if name in offered]
        if not usable:
            raise Unsupported(f"{self.name} sends only {', '.join(offered)}: a grey camera is needed")
        chosen = self._settings.pixel_format or usable[0]
        if chosen not in usable:
            raise BadValue(f"pixel_format = {chosen} is not one of {', '.join(usable)}, which {self.name} sends")
        self._line.set_text("PixelFormat", chosen)
        return chosen

    def _prepare(self) -> None:
        """Reset the camera to a defined mode."""
        line, settings = self._line, self._settings
        for feature, value in (("ExposureAuto", "Off"), ("GainAuto", "Off"), ("AcquisitionMode", "Continuous")):
            if value in line.choices(feature):
                line.set_text(feature, value)
        if line.has("ChunkModeActive"):
            line.call("arv_camera_set_boolean", b"ChunkModeActive", 0)
        if settings.binning != 1 or self._read_binning() != 1:
            self.set_binning(settings.binning)
        sensor = self.capabilities.sensor
        if sensor is not None:
            self.set_region(settings.region or sensor)
        self.set_trigger(settings.trigger)
        if settings.gain is not None:
            gains = Range(*line.bounds("arv_camera_get_gain_bounds"))
            line.call("arv_camera_set_gain", gains.check(settings.gain, "gain"))
        if settings.exposure_s is not None:
            self.set_exposure(settings.exposure_s)

    def _read_capabilities(self) -> CameraCapabilities:
        line = self._line
        _, _, columns, rows = line.region()
        shortest_us, longest_us = line.bounds("arv_camera_get_exposure_time_bounds")
        sources = [source for source in line.choices("TriggerSource") if source != "Software"]
        return CameraCapabilities(
            rows=rows,
            columns=columns,
            pixel_pitch_m=self._pixel_pitch_m(),
            full_scale=self._full_scale(),
            exposure_range_s=Range(shortest_us / 1e6, longest_us / 1e6),
            em_gain_range=Range(1.0, 1.0),
            amplifiers=("normal",),
            binnings=self._binnings(),
            triggers=(_INTERNAL, *sources),
            sensor=self._sensor(),
            region_step_px=self._region_step() * self._read_binning(),
        )

    def _sensor(self) -> Region:
        if self._line.has("SensorWidth") and self._line.has("SensorHeight"):
            return Region(0, 0, self._line.integer("SensorHeight"), self._line.integer("SensorWidth"))
        binning = self._read_binning()
        return Region(0, 0, self._line.integer("HeightMax") * binning, self._line.integer("WidthMax") * binning)

    def _pixel_pitch_m(self) -> float | None:
        pitch_m = self._settings.pixel_pitch_m
        if pitch_m is None and self._line.has("SensorPixelWidth"):
            pitch_m = self._line.number("SensorPixelWidth") * 1e-6
        return None if pitch_m is None else pitch_m * self._read_binning()

    def _full_scale(self) -> int:
        """Count at which a pixel saturates; the digitiser may have fewer bits than the format."""
        if self._line.has("PixelDynamicRangeMax"):
            return min(self._format.full_scale, self._line.integer("PixelDynamicRangeMax"))
        return self._format.full_scale

    def _binnings(self) -> tuple[int, ...]:
        """Binnings available on both axes."""
        if not self._line.call("arv_camera_is_binning_available"):
            return (1,)
        both = (self._line.integer_bounds(f"Binning{axis}") for axis in ("Horizontal", "Vertical"))
        across, down = (set(range(low, min(high, _LARGEST_BINNING) + 1, step)) for low, high, step in both)
        return tuple(sorted(across & down))

    def _region_step(self) -> int:
        """Common step of all sides of a region, in binned pixels."""
        return math.lcm(*(self._line.integer_bounds(side)[2] for side in ("OffsetX", "OffsetY", "Width", "Height")))

    def _is_running(self) -> bool:
        return self._line.is_streaming

    def _start(self) -> None:
        allowed = self.capabilities
        expected = allowed.rows * allowed.columns * self._format.stored.itemsize
        payload = self._line.call("arv_camera_get_payload")
        if payload != expected:
            raise Unsupported(f"{self.name} sends {payload} bytes per frame instead of {expected}")
        self._count = FrameCount()
        self._exposures = ExposureLog.beginning_with(self._read_exposure())
        self._line.start_stream(payload)

    def _stop(self) -> None:
        self._line.stop_stream(self._read_exposure())

    def _read(self, timeout_s: float) -> Frame:
        deadline_s = time.perf_counter() + timeout_s
        while True:
            left_s = max(0.0, deadline_s - time.perf_counter())
            if buffer := self._line.next_buffer(min(left_s, _SLICE_S)):
                try:
                    return self._frame(buffer)
                finally:
                    self._line.give_back(buffer)
            self._line.watch()
            if left_s <= _SLICE_S:
                raise DeviceTimeout(f"no frame came within {timeout_s:g} s")

    def _frame(self, buffer: int) -> Frame:
        """Copy a frame out of its buffer; raise `FrameLost` if packets are missing."""
        allowed = self.capabilities
        size = c_size_t()
        address = self._aravis.call("arv_buffer_get_data", buffer, byref(size))
        status = self._aravis.call("arv_buffer_get_status", buffer)
        if status != STATUS_SUCCESS or size.value < allowed.rows * allowed.columns * self._format.stored.itemsize:
            self._incomplete += 1
            raise FrameLost(f"a frame arrived incomplete, the {self._incomplete}. so far: packets were lost")
        sent_s = self._aravis.call("arv_buffer_get_system_timestamp", buffer) / 1e9
        return Frame(
            pixels=copied_pixels(address, allowed.rows, allowed.columns, self._format),
            index=self._count.advance(self._aravis.call("arv_buffer_get_frame_id", buffer)),
            camera_time_s=self._aravis.call("arv_buffer_get_timestamp", buffer) / 1e9,
            host_time_s=time.perf_counter(),
            exposure_s=self._exposures.of_frame(sent_s),
            em_gain=1.0,
        )

    def _read_exposure(self) -> float:
        return float(self._line.call("arv_camera_get_exposure_time")) / 1e6

    def _set_exposure(self, exposure_s: float) -> float:
        shortest_us, longest_us = self._line.bounds("arv_camera_get_exposure_time_bounds")
        exposure_us = min(max(round(exposure_s * 1e6, 3), shortest_us), longest_us)
        self._line.call("arv_camera_set_exposure_time", exposure_us)
        taken_s = self._read_exposure()
        self._exposures.change(time.time(), taken_s)
        return taken_s

    def _read_binning(self) -> int:
        available = self._line.call("arv_camera_is_binning_available")
        return self._line.integer("BinningHorizontal") if available else 1

    def _set_binning(self, binning: int) -> None:
        before, before_region = self._read_binning(), self._read_region()
        asked = self._asked_region or before_region

        def undo() -> None:
            self._line.call("arv_camera_set_binning", before, before)
            self._write_region(before_region)

        with _undone_if_refused(undo):
            self._line.call("arv_camera_set_binning", binning, binning)
            step = self._region_step() * binning
            top, left = (offset - offset % step for offset in (asked.top, asked.left))
            rows, columns = (max(step, length - length % step) for length in (asked.rows, asked.columns))
            self._write_region(Region(top, left, rows, columns))

    def _read_trigger(self) -> str:
        if self._line.choices("TriggerMode") and self._line.text("TriggerMode") == "On":
            return self._line.text("TriggerSource")
        return _INTERNAL

    def _set_trigger(self, trigger: str) -> None:
        before = self._read_trigger()
        with _undone_if_refused(lambda: self._write_trigger(before)):
            self._write_trigger(trigger)

    def _write_trigger(self, trigger: str) -> None:
        if trigger != _INTERNAL:
            self._line.call("arv_camera_set_trigger", trigger.encode())
            return
        if self._line.choices("TriggerMode"):
            self._line.call("arv_camera_clear_triggers")
        if self._line.call("arv_camera_is_frame_rate_available"):
            self._line.call("arv_camera_set_frame_rate", self._settings.frame_rate_hz or 0.0)

    def _read_region(self) -> Region:
        binning = self._read_binning()
        left, top, columns, rows = (number * binning for number in self._line.region())
        return Region(top, left, rows, columns)

    def _set_region(self, region: Region) -> Region:
        before = self._read_region()
        with _undone_if_refused(lambda: self._write_region(before)):
            self._write_region(region)
        self._asked_region = region
        return self._read_region()

    def _write_region(self, region: Region) -> None:
        binning = self._read_binning()
        rows, columns = region.rows // binning, region.columns // binning
        fewest_rows, fewest_columns = (self._line.integer_bounds(side)[0] for side in ("Height", "Width"))
        if rows < fewest_rows or columns < fewest_columns:
            raise BadValue(
                f"{self.name} reads out at least {fewest_rows * binning} rows and {fewest_columns * binning} columns"
            )
        self._line.call("arv_camera_set_region", region.left // binning, region.top // binning, columns, rows)


@contextmanager
def _undone_if_refused(undo: Callable[[], None]) -> Iterator[None]:
    """Call `undo` after a failure of one of several steps."""
    try:
        yield
    except Disconnected:
        raise
    except DeviceError:
        undo()
        raise
