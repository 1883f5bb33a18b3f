"""Cameras behind Micro-Manager's device adapters.

Micro-Manager's core hides what the adapters do: docs/devices_micro_manager.md lists the limits of this driver. The
thread of a running adapter may use its properties without a lock: reading them meanwhile corrupted the memory of the
DemoCamera, with which the tests run. So they are read at rest and remembered. Not yet tried on a real camera.
"""

import time
from contextlib import suppress
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from drivers.camera import CLOSING, NO_FRAME, STOPPED, Camera, CameraCapabilities, Frame, Region, SettingsInForce
from drivers.device import DiscoveredDevice, Property, Range
from drivers.errors import (
    DeviceError,
    DeviceTimeout,
    Disconnected,
    FrameLost,
    Unsupported,
    WrongState,
    undone_if_refused,
)
from drivers.micro_manager import MicroManagerSettings
from drivers.micro_manager._core import LABEL, LoadedCamera, load_pymmcore

_POLL_S: Final = 1e-3  # between two looks for a frame: the core offers no event
_CHECK_S: Final = 0.1  # between two checks of a silent camera
_SILENCE_S: Final = 2.0  # beyond the exposure; after that the camera counts as lost
_SHORTEST_S: Final = 1e-3  # if the adapter reports 0; many round to 0.01 ms
_LONGEST_S: Final = 60.0  # if the adapter reports no limit
_NUMBERS_NOTE: Final = "by Micro-Manager's core: a frame lost before it leaves no gap"


def discover() -> tuple[DiscoveredDevice, ...]:
    """Raise `Unsupported`: searching would load the library of every maker."""
    load_pymmcore()
    raise Unsupported("name adapter and device in a bench, then `svwfs devices --check camera --bench B`")


class MicroManagerCamera(Camera):
    """An open camera; `core` replaces Micro-Manager's in tests."""

    def __init__(self, settings: MicroManagerSettings, *, core: Any = None) -> None:
        super().__init__()
        self._settings = settings
        core = core or load_pymmcore().CMMCore()
        self._is_started = self._is_aborted = False
        self._checked_s = 0.0
        self._heard_s = 0.0  # last sign of life; in the future while a long exposure ends
        self._last = -1  # index of the last frame
        self._in_force = SettingsInForce(0.0, 1.0)
        self._details: dict[str, Property] = {}  # the adapter's properties when last at rest
        self._mode = 1, Region(0, 0, 0, 0)  # binning and region of the running camera
        try:
            self._adapter = LoadedCamera(
                core, adapter=settings.adapter, device=settings.device, folder=settings.adapter_folder
            )
            self._adapter.initialize(settings.properties)
            self._name = f"{self._adapter.call('getDeviceDescription', LABEL)} ({settings.adapter}, {settings.device})"
            self._set_up()
        except BaseException:
            with suppress(RuntimeError):
                core.reset()
            raise

    def _set_up(self) -> None:
        """Determine the sensor, and apply the settings."""
        if self._adapter.call("getNumberOfComponents") != 1 or self._adapter.call("getBytesPerPixel") not in (1, 2):
            raise Unsupported("only cameras that give one 8- or 16-bit number per pixel can be used: set PixelType")
        self._binnings = self._find_binnings()
        if 1 in self._binnings:
            self._set_binning_text(1)
        self._adapter.call("clearROI")
        self._em_gain = self._ask_em_gain()  # nothing changes it later
        binning = self._read_binning()
        rows, columns = (binning * self._adapter.call(f"getImage{side}") for side in ("Height", "Width"))
        self._sensor = Region(0, 0, rows, columns)
        settings = self._settings
        self._apply(binning=settings.binning, region=settings.region, exposure=settings.exposure_s)
        self._read_details()

    def properties(self) -> dict[str, Property]:
        """All settings in force, versions, and every property of the adapter by its name."""
        details = super().properties() | {"frame numbers": _NUMBERS_NOTE}
        with self._access():
            versions = (self._adapter.call(name) for name in ("getVersionInfo", "getAPIVersionInfo"))
            details["Micro-Manager"] = ", ".join(versions)
            if not self._is_started:
                self._read_details()
        return details | self._details

    def _read_details(self) -> None:
        """Read the adapter's properties, except those among the settings."""
        for name in self._adapter.property_names():
            try:
                self._details[name] = self._adapter.call("getProperty", LABEL, name)
            except Disconnected:
                raise
            except DeviceError as error:
                self._details[name] = str(error)
        for name in ("Exposure", "Binning"):
            self._details.pop(name, None)

    def _close(self) -> None:
        self._is_aborted = True  # ends `read` in another thread
        with self._lock:
            with suppress(DeviceError):
                self._stop()
            self._adapter.unload()

    def _read_capabilities(self) -> CameraCapabilities:
        limits_ms = self._adapter.limits("Exposure") or (0.0, 1e3 * _LONGEST_S)
        binning, pitch_m = self._read_binning(), self._settings.pixel_pitch_m
        return CameraCapabilities(
            rows=self._adapter.call("getImageHeight"),
            columns=self._adapter.call("getImageWidth"),
            pixel_pitch_m=None if pitch_m is None else binning * pitch_m,
            full_scale=self._settings.full_scale or 2 ** self._adapter.call("getImageBitDepth") - 1,
            exposure_range_s=Range(max(1e-3 * limits_ms[0], _SHORTEST_S), 1e-3 * limits_ms[1]),
            em_gain_range=Range(self._em_gain, self._em_gain),
            binnings=tuple(sorted(self._binnings)),
            sensor=self._sensor,
            region_step_px=binning,
        )

    def _read_exposure(self) -> float:
        return self._in_force.newest[0] if self._is_started else self._ask_exposure()

    def _ask_exposure(self) -> float:
        return 1e-3 * float(self._adapter.call("getExposure", LABEL))

    def _read_em_gain(self) -> float:
        return self._em_gain

    def _ask_em_gain(self) -> float:
        """Return the EM gain of an Andor iXon, whose adapter is the one with an `EMSwitch`; else 1."""
        names = self._adapter.property_names()
        if "EMSwitch" not in names or self._adapter.call("getProperty", LABEL, "EMSwitch") != "On":
            return 1.0
        if "Output_Amplifier" in names and "Conv" in self._adapter.call("getProperty", LABEL, "Output_Amplifier"):
            return 1.0
        return max(1.0, float(self._adapter.call("getProperty", LABEL, "Gain")))

    def _set_exposure(self, exposure_s: float) -> float:
        before_s = self._read_exposure()
        self._adapter.call("setExposure", LABEL, 1e3 * exposure_s)
        taken_s = self._ask_exposure()
        if self._is_started:
            self._heard_s = time.monotonic() + before_s
            newest = self._adapter.newest()  # the one after it is being exposed
            self._in_force.change((self._last if newest is None else newest) + 2, taken_s, self._em_gain)
        return taken_s

    def _find_binnings(self) -> dict[int, str]:
        """Square binnings and the adapter's texts for them, such as "2" or "2x2"."""
        if "Binning" not in self._adapter.property_names():
            return {1: ""}
        texts = self._adapter.call("getAllowedPropertyValues", LABEL, "Binning")
        factors = {
            text: set(text.lower().split("x"))
            for text in texts or [self._adapter.call("getProperty", LABEL, "Binning")]
        }
        return {int(min(sides)): text for text, sides in factors.items() if len(sides) == 1 and min(sides).isdigit()}

    def _read_binning(self) -> int:
        if self._is_started:
            return self._mode[0]
        if not any(self._binnings.values()):
            return 1
        text = self._adapter.call("getProperty", LABEL, "Binning")
        return next((factor for factor, known in self._binnings.items() if known == text), 1)

    def _set_binning(self, binning: int) -> None:
        before, region = self._read_binning(), self._read_region()
        kept = region
        if region != self._sensor:
            top, left = (offset - offset % binning for offset in (region.top, region.left))
            rows, columns = (max(binning, length - length % binning) for length in (region.rows, region.columns))
            kept = Region(top, left, rows, columns)

        def write(factor: int, region: Region) -> None:
            self._set_binning_text(factor)
            self._write_region(region)

        with undone_if_refused(lambda: write(before, region)):
            write(binning, kept)

    def _set_binning_text(self, binning: int) -> None:
        if self._binnings[binning]:
            self._adapter.set_property("Binning", self._binnings[binning])

    def _read_region(self) -> Region:
        if self._is_started:
            return self._mode[1]
        binning = self._read_binning()
        left, top, columns, rows = self._adapter.call("getROI", LABEL)
        if (rows, columns) == (self._sensor.rows // binning, self._sensor.columns // binning):
            return self._sensor
        return Region(binning * top, binning * left, binning * rows, binning * columns)

    def _set_region(self, region: Region) -> Region:
        self._write_region(region)
        return self._read_region()

    def _write_region(self, region: Region) -> None:
        binning = self._read_binning()
        if region == self._sensor:
            self._adapter.call("clearROI")
            return
        sides = (region.left, region.top, region.columns, region.rows)
        self._adapter.call("setROI", LABEL, *(side // binning for side in sides))

    def _is_running(self) -> bool:
        return self._is_started

    def _start(self) -> None:
        allowed = self.capabilities
        frame_bytes = self._adapter.call("getBytesPerPixel") * allowed.rows * allowed.columns
        self._adapter.call("setCircularBufferMemoryFootprint", 1 + self._settings.ring_frames * frame_bytes // 2**20)
        self._in_force = SettingsInForce(self._ask_exposure(), self._em_gain)
        self._mode = self._read_binning(), self._read_region()
        self._adapter.call("startContinuousSequenceAcquisition", 0)
        self._is_started, self._last = True, -1
        self._heard_s = time.monotonic()

    def _stop(self) -> None:
        if self._is_started:
            self._adapter.call("stopSequenceAcquisition", LABEL)
            self._is_started = False

    def _read(self, timeout_s: float) -> Frame:
        start_s = time.monotonic()
        while (taken := self._adapter.pop()) is None:
            now_s = time.monotonic()
            if self._is_aborted:
                raise WrongState(CLOSING)
            if now_s >= self._checked_s + _CHECK_S:
                self._checked_s = now_s
                self._check_alive(now_s)
            if now_s - start_s >= timeout_s:
                raise DeviceTimeout(NO_FRAME)
            time.sleep(min(_POLL_S, timeout_s))
        return self._frame(*taken)

    def _check_alive(self, now_s: float) -> None:
        """Raise if a silent camera is gone or has stopped."""
        exposure_s = self._read_exposure()
        if not self._adapter.call("isSequenceRunning", LABEL):
            self._is_started = False
            raise WrongState(STOPPED)
        if now_s - self._heard_s > exposure_s + _SILENCE_S:
            raise Disconnected(
                f"the camera has sent no frame for {now_s - self._heard_s:.1f} s: check its power and cable,"
                " then connect again"
            )

    def _frame(self, pixels: NDArray[np.unsignedinteger], number: int, camera_time_s: float) -> Frame:
        host_time_s, self._heard_s = time.perf_counter(), time.monotonic()
        self._checked_s = self._heard_s
        self._last = number
        if pixels.shape != (self.capabilities.rows, self.capabilities.columns) or pixels.dtype.itemsize > 2:
            raise FrameLost(f"a frame of {pixels.shape} pixels came, unlike the region")
        pixels = pixels.astype(np.uint16, copy=False)
        pixels.setflags(write=False)
        exposure_s, em_gain = self._in_force.of_frame(number)
        return Frame(
            pixels=pixels,
            index=number,
            camera_time_s=camera_time_s,
            host_time_s=host_time_s,
            exposure_s=exposure_s,
            em_gain=em_gain,
        )
