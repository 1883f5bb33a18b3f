"""GigE Vision and USB3 Vision cameras over Aravis.

The camera numbers the frames: lost packets and missing buffers show as gaps. The analogue gain is a separate setting,
and the EM gain is 1. Not yet tried on a real camera; the tests use Aravis's fake camera, over UDP.
"""

import time
from ctypes import byref, c_int, c_size_t
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.camera import CLOSING, INTERNAL, NO_FRAME, Camera, CameraCapabilities, Frame, Region, SettingsInForce
from drivers.device import DiscoveredDevice, Property, Range
from drivers.errors import BadValue, DeviceTimeout, FrameLost, Unsupported, WrongState, attempt, undone_if_refused
from drivers.genicam import GenicamSettings
from drivers.genicam import _features as features
from drivers.genicam import _frames as frames
from drivers.genicam._connection import GenicamConnection, chosen, update_list
from drivers.genicam._library import STATUS_SUCCESS, load_aravis

_SLICE_S: Final = 0.1  # of silence, after which the connection is watched; the longest wait in the library
# properties, if the camera has them
_PROPERTIES_AS_TEXT: Final = (
    *("DeviceVersion", "DeviceFirmwareVersion", "DeviceUserID", "BinningHorizontalMode", "BinningVerticalMode"),
    *features.DIGITISERS,
    *features.RESETS,
)
_PROPERTIES_AS_NUMBER: Final = ("DeviceTemperature", "BlackLevel")


def discover() -> tuple[DiscoveredDevice, ...]:
    """Return the cameras that answer within about a second; raise `Unsupported` if the library is missing."""
    aravis = load_aravis()
    update_list(aravis)
    cameras = []
    for i in range(aravis.call("arv_get_n_devices")):
        details = (aravis.call(f"arv_get_device_{detail}", i) for detail in ("vendor", "model", "serial_nbr"))
        description = " ".join(filter(None, details))
        settings = {"device": aravis.call("arv_get_device_id", i)}
        cameras.append(DiscoveredDevice(kind="camera", driver="genicam", description=description, settings=settings))
    return tuple(cameras)


class GenicamCamera(Camera):
    """An open GenICam camera."""

    def __init__(self, settings: GenicamSettings | None = None) -> None:
        super().__init__()
        self._settings = settings = settings or GenicamSettings()
        self._aravis = load_aravis()
        device = chosen(settings.device)
        self._connection = GenicamConnection(self._aravis, device, settings)
        self._count = frames.FrameCount()
        self._in_force = SettingsInForce(0.0, 1.0)  # of frames that end at some time
        self._incomplete = 0
        self._heard_s = 0.0  # time of the last buffer, or of the start
        self._is_aborted = False
        self._asked_region: Region | None = None  # may be no multiple of the binning
        try:
            details = ("vendor_name", "model_name", "device_serial_number")
            self._name = " ".join(
                filter(None, (self._connection.call(f"arv_camera_get_{detail}") for detail in details))
            )
            attempt(self._connection.call, "arv_camera_execute_command", b"AcquisitionStop")
            features.reset(self._connection, features.RESETS)
            self._geometry = features.Geometry(self._connection)
            self._prepare_pixels()
            self._exposure = features.ExposureTime(self._connection)
            self._prepare()
        except BaseException:
            self._connection.close()
            raise

    def properties(self) -> dict[str, Property]:
        """All settings in force and further details for the record."""
        connection = self._connection
        details = super().properties()
        with self._access():
            details["protocol"] = "GigE Vision" if connection.is_gige else "USB3 Vision"
            details["Aravis"] = ".".join(
                str(self._aravis.call(f"arv_get_{part}_version")) for part in ("major", "minor")
            )
            details["pixel_format"] = self._format.name
            details["byte_order"] = self._byte_order
            details["full_scale"] = self.capabilities.full_scale
            readings = {"gain": "arv_camera_get_gain", "frame_rate_hz": "arv_camera_get_frame_rate"}
            if connection.is_gige:
                readings["packet_size"] = "arv_camera_gv_get_packet_size"
            found: dict[str, Property | None] = {key: attempt(connection.call, name) for key, name in readings.items()}
            found |= {name: connection.optional_text(name) for name in _PROPERTIES_AS_TEXT}
            found |= {name: attempt(connection.number, name) for name in _PROPERTIES_AS_NUMBER}
        details |= {key: value for key, value in found.items() if value is not None}
        return details | {"incomplete_frames": self._incomplete}

    def _close(self) -> None:
        self._is_aborted = True  # ends `read` in another thread
        with self._lock:
            try:
                if self._connection.is_streaming and not self._loss:
                    self._stop()
            finally:
                self._connection.close()

    def _prepare_pixels(self) -> None:
        """Set the format of the settings, or the one that suits the digitiser best."""
        connection, settings = self._connection, self._settings
        offered = connection.choices("PixelFormat")
        asked = frames.PIXEL_FORMATS.get(settings.pixel_format)
        deepest = frames.preferred_format(offered, None)
        if deepest is None:
            raise Unsupported(f"{self.name} offers {', '.join(offered) or 'no pixel format'}: a grey camera is needed")
        if asked and asked.name not in offered:
            usable = ", ".join(name for name in frames.PIXEL_FORMATS if name in offered)
            raise BadValue(f"pixel_format = {asked.name} is not one of {usable}, which {self.name} sends")
        connection.set_text("PixelFormat", (asked or deepest).name)  # some digitisers follow it, as of the Basler ace 2
        digitiser_bits = features.set_digitiser(connection, asked.bits if asked else 16)
        self._format: frames.PixelFormat = asked or frames.preferred_format(offered, digitiser_bits) or deepest
        connection.set_text("PixelFormat", self._format.name)
        self._saturation = frames.Saturation(self._format, digitiser_bits)
        is_big = connection.optional_text("GevSCPSBigEndian") == "true"
        self._byte_order = settings.byte_order or frames.byte_order_of(self.name, is_reported_big=is_big)

    def _prepare(self) -> None:
        """Set the camera to a defined mode."""
        connection, settings = self._connection, self._settings
        if settings.binning != 1 or self._read_binning() != 1:
            self.set_binning(settings.binning)
        sensor = self.capabilities.sensor
        if sensor is not None:
            self.set_region(settings.region or sensor)
        elif settings.region is not None:
            raise Unsupported(f"{self.name} always reads out its whole sensor: omit region")
        else:  # it may be cropped
            attempt(lambda: self._geometry.set_region(self._geometry.sensor()))
        self.set_trigger(settings.trigger)
        if settings.gain is not None:
            gains = Range(*connection.outputs("arv_camera_get_gain_bounds"))
            connection.call("arv_camera_set_gain", gains.check(settings.gain, "gain"))
        self._apply(exposure=settings.exposure_s)

    def _read_capabilities(self) -> CameraCapabilities:
        connection, geometry, settings = self._connection, self._geometry, self._settings
        _, _, columns, rows = connection.region()
        self._saturation.reported = attempt(connection.integer, "PixelDynamicRangeMax")
        return CameraCapabilities(
            rows=rows,
            columns=columns,
            pixel_pitch_m=self._pixel_pitch_m(),
            full_scale=settings.full_scale or self._saturation.counts,
            exposure_range_s=self._exposure.range_s(),
            binnings=geometry.binnings(),
            triggers=features.sources(connection),
            sensor=geometry.sensor() if geometry.has_offsets else None,
            region_step_px=geometry.region_step_px(),
        )

    def _pixel_pitch_m(self) -> float | None:
        pitch_m = self._settings.pixel_pitch_m
        if pitch_m is None and (reported_um := attempt(self._connection.number, "SensorPixelWidth")):
            pitch_m = reported_um * 1e-6
        return None if pitch_m is None else pitch_m * self._read_binning()

    def _is_running(self) -> bool:
        return self._connection.is_streaming

    def _start(self) -> None:
        allowed = self.capabilities
        expected = self._format.size_bytes(allowed.rows * allowed.columns)
        payload = self._connection.call("arv_camera_get_payload")
        if payload < expected:
            raise Unsupported(f"{self.name} sends {payload} bytes per frame instead of {expected} or more")
        self._count = frames.FrameCount()
        self._in_force = SettingsInForce(self._read_exposure(), 1.0)
        self._connection.start_stream(payload)
        self._heard_s = time.perf_counter()

    def _stop(self) -> None:
        self._connection.stop_stream(self._read_exposure())

    def _read(self, timeout_s: float) -> Frame:
        deadline_s = time.perf_counter() + timeout_s
        while True:
            left_s = max(0.0, deadline_s - time.perf_counter())
            if buffer := self._connection.next_buffer(min(left_s, _SLICE_S)):
                self._heard_s = time.perf_counter()
                try:
                    return self._frame(buffer)
                finally:
                    self._connection.give_back(buffer)
            if self._is_aborted:
                raise WrongState(CLOSING)
            if time.perf_counter() > self._heard_s + _SLICE_S:
                self._connection.watch()
            if left_s <= _SLICE_S:
                raise DeviceTimeout(NO_FRAME)

    def _frame(self, buffer: int) -> Frame:
        """Copy a frame out of its buffer; raise `FrameLost` if packets are missing."""
        rows, columns = shape = self.capabilities.rows, self.capabilities.columns
        size, padding = c_size_t(), c_int()
        address = self._aravis.call("arv_buffer_get_data", buffer, byref(size))
        status = self._aravis.call("arv_buffer_get_status", buffer)
        if status == STATUS_SUCCESS and self._aravis.has("arv_buffer_get_image_padding"):  # else it complains
            self._aravis.call("arv_buffer_get_image_padding", buffer, byref(padding), byref(c_int()))
        needed = self._format.size_bytes(rows * columns) + (rows - 1) * padding.value
        if status != STATUS_SUCCESS or size.value < needed:
            self._incomplete += 1
            raise FrameLost(f"a frame arrived incomplete, the {self._incomplete}. so far: packets were lost")
        sent_s = self._aravis.call("arv_buffer_get_system_timestamp", buffer) / 1e9
        pixels = frames.copied_pixels(
            address, shape, row_padding_bytes=padding.value, pixel_format=self._format, byte_order=self._byte_order
        )
        self._observe_saturation(pixels)
        host_time_s = time.perf_counter()
        exposure_s, em_gain = self._in_force.of_frame(sent_s)
        return Frame(
            pixels=pixels,
            index=self._count.advance(self._aravis.call("arv_buffer_get_frame_id", buffer), sent_s),
            camera_time_s=self._aravis.call("arv_buffer_get_timestamp", buffer) / 1e9 or host_time_s,  # 0: has no clock
            host_time_s=host_time_s,
            exposure_s=exposure_s,
            em_gain=em_gain,
        )

    def _observe_saturation(self, pixels: NDArray[np.uint16]) -> None:
        """Let the full scale follow the bits that the frames use."""
        self._saturation.observe(pixels)
        counts = self._settings.full_scale or self._saturation.counts
        if counts != self.capabilities.full_scale:
            self._cached_capabilities = replace(self.capabilities, full_scale=counts)

    def _read_temperature(self) -> float | None:
        return attempt(self._connection.number, "DeviceTemperature")

    def _read_exposure(self) -> float:
        return self._exposure.read_s()

    def _set_exposure(self, exposure_s: float) -> float:
        self._exposure.set_s(exposure_s)
        taken_s = self._read_exposure()
        self._in_force.change(time.time() + taken_s, taken_s, 1.0)  # the first that begins now
        return taken_s

    def _read_binning(self) -> int:
        return self._geometry.binning()

    def _set_binning(self, binning: int) -> None:
        before, before_region = self._read_binning(), self._read_region()
        asked = self._asked_region or before_region

        def undo() -> None:
            self._geometry.set_binning(before)
            self._geometry.set_region(before_region)

        with undone_if_refused(undo):
            self._geometry.set_binning(binning)
            self._geometry.set_region(self._geometry.nearest(asked))

    def _read_trigger(self) -> str:
        return features.trigger(self._connection)

    def _set_trigger(self, source: str) -> None:
        before = self._read_trigger()
        with undone_if_refused(lambda: self._write_trigger(before)):
            self._write_trigger(source)

    def _write_trigger(self, source: str) -> None:
        features.reset(self._connection, features.FRAME_RATE)
        features.set_trigger(self._connection, source)
        if source == INTERNAL and self._settings.frame_rate_hz is not None:
            self._connection.call("arv_camera_set_frame_rate", self._settings.frame_rate_hz)

    def _read_region(self) -> Region:
        return self._geometry.region()

    def _set_region(self, region: Region) -> Region:
        before = self._read_region()
        with undone_if_refused(lambda: self._geometry.set_region(before)):
            self._geometry.set_region(region)
        self._asked_region = region
        return self._read_region()
