"""Micro-Manager's core with its DemoCamera and faults, and the driver over it."""

from __future__ import annotations

from typing import Any

import mm_test_adapters
import pymmcore

from drivers.micro_manager import MicroManagerSettings
from drivers.micro_manager.camera import MicroManagerCamera

FOLDER = mm_test_adapters.device_adapter_path()
# 16 bits; no rendering, which takes longer than the exposure; stopping waits for the end of the exposure.
PROPERTIES = {"PixelType": "16bit", "BitDepth": "16", "FastImage": "1", "MaximumExposureMs": "1000"}
_OF_THE_CORE = {"loadDevice", "setDeviceAdapterSearchPaths", "getDeviceType"}


class FaultyCore:
    """A core whose camera can be unplugged, stalled, or refuse a setting; until then the calls go to Micro-Manager."""

    def __init__(self) -> None:
        self.core = pymmcore.CMMCore()
        self.is_unplugged = self.is_silent = False
        self.does_stop = True  # although unplugged
        self.resets_region = False  # when binning changes, as some adapters do
        self.to_lose = 0
        self.refused: list[str] = []  # functions whose next call fails
        self.asked: list[str] = []  # functions called

    def __getattr__(self, name: str) -> Any:
        self.asked.append(name)
        if self.is_unplugged and name not in _OF_THE_CORE:
            raise RuntimeError("Error in device: communication failed")
        if name in self.refused:
            self.refused.remove(name)
            raise RuntimeError(f"Error in device: {name} failed")
        return getattr(self.core, name)

    def reset(self) -> None:
        if self.does_stop and self.core.isSequenceRunning():
            self.core.stopSequenceAcquisition()
        self.core.reset()

    def setProperty(self, label: str, name: str, value: str) -> None:  # noqa: N802 - the core's name
        self.__getattr__("setProperty")(label, name, value)
        if name == "Binning" and self.resets_region:
            self.core.clearROI()

    def getRemainingImageCount(self) -> int:  # noqa: N802 - the core's name
        if self.is_unplugged or self.is_silent:
            return 0
        while self.to_lose and self.core.getRemainingImageCount():
            self.core.popNextImage()
            self.to_lose -= 1
        return int(self.core.getRemainingImageCount())


class DemoCamera:
    """The camera on the desk: each opening makes a new core, with the faults in force."""

    def __init__(self) -> None:
        self.faulty = FaultyCore()

    def open(self, properties: dict[str, str] | None = None, **settings: Any) -> MicroManagerCamera:
        core = FaultyCore()
        core.is_unplugged = self.faulty.is_unplugged
        self.faulty = core
        values = {"adapter": "DemoCamera", "device": "DCam", "adapter_folder": FOLDER} | settings
        return MicroManagerCamera(MicroManagerSettings(properties=PROPERTIES | (properties or {}), **values), core=core)

    def unplug(self) -> None:
        self.faulty.is_unplugged = True

    def plug_in(self) -> None:
        self.faulty.is_unplugged = self.faulty.is_silent = False

    def stall(self) -> None:
        self.faulty.is_silent = True

    def lose_frames(self, count: int) -> None:
        self.faulty.to_lose += count

    def refuse_next(self) -> None:
        self.faulty.refused.append("setExposure")
