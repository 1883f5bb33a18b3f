"""Cameras behind Micro-Manager's device adapters, called through pymmcore: their settings."""

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Annotated, Literal

from annotated_types import Ge, Le, MinLen
from typing_extensions import Doc

from drivers.camera import ExposureSetting, PitchSetting, RegionSetting


@dataclass(frozen=True, slots=True, kw_only=True)
class MicroManagerSettings:
    """Selection and settings of a camera; what is omitted keeps its value. Opening it checks what depends on it."""

    driver: Literal["micro_manager"] = "micro_manager"
    adapter: Annotated[str, MinLen(1), Doc('Device adapter, for example "AndorSDK3"')]
    device: Annotated[str, MinLen(1), Doc('Name of the camera in the adapter, for example "Andor sCMOS Camera"')]
    adapter_folder: Annotated[str, Doc("Folder of Micro-Manager with its adapters")] = ""
    properties: Annotated[dict[str, str], Doc("Properties, by the adapter's names")] = field(default_factory=dict)
    pixel_pitch_m: PitchSetting | None = None
    full_scale: Annotated[int, Ge(1), Le(65535), Doc("Count of a saturated pixel, if not 2**bits - 1")] | None = None
    exposure_s: ExposureSetting | None = None
    binning: Annotated[int, Ge(1), Le(64)] = 1
    region: RegionSetting | None = None
    ring_frames: Annotated[int, Ge(4), Le(10000), Doc("Frames buffered before the oldest are overwritten")] = 64

    def faults(self) -> Iterator[tuple[str, str]]:
        """Yield settings that contradict others, and why."""
        if not re.fullmatch(r"[A-Za-z0-9_.-]+", self.adapter):  # a slash would load a library anywhere on the disk
            yield "adapter", "must be a name of letters, digits, '_', '.' and '-'"
