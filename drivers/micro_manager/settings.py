"""Bench settings of a camera behind Micro-Manager: `[camera]` with driver "micro_manager"."""

import math
import re
from dataclasses import dataclass, field
from typing import Literal

from drivers.frame import Region


@dataclass(frozen=True, slots=True, kw_only=True)
class MicroManagerSettings:
    """Selection and settings of a camera; what is omitted keeps the camera's value.

    Opening the camera checks what depends on it: exposure, binning, region, properties.
    """

    driver: Literal["micro_manager"] = "micro_manager"
    adapter: str  # for example "AndorSDK3"
    device: str  # name of the camera in the adapter, for example "Andor sCMOS Camera"
    adapter_folder: str = ""  # where Micro-Manager is installed
    properties: dict[str, str] = field(default_factory=dict)  # set at open, by the adapter's names
    pixel_pitch_m: float | None = None  # of the sensor; Micro-Manager does not know it
    full_scale: int | None = None  # count at which a pixel saturates, if not 2**bits - 1
    exposure_s: float | None = None
    binning: int = 1
    region: Region | None = None  # the whole sensor
    ring_frames: int = 64  # buffered before the oldest are overwritten

    def __post_init__(self) -> None:
        conditions = {
            f"{key} must be positive": value is None or 0 < value < math.inf
            for key, value in (("pixel_pitch_m", self.pixel_pitch_m), ("exposure_s", self.exposure_s))
        } | {
            "adapter and device must be named": bool(self.adapter and self.device),
            # with a slash, a library anywhere on the disk would be loaded
            "adapter must be a name of letters, digits, '_', '.' and '-'": re.fullmatch(
                r"[A-Za-z0-9_.-]+", self.adapter
            ),
            "full_scale must be 1 ... 65535": self.full_scale is None or 1 <= self.full_scale <= 65535,
            "binning must be 1 ... 64": 1 <= self.binning <= 64,
            "ring_frames must be 4 ... 10000": 4 <= self.ring_frames <= 10000,
        }
        for sentence, holds in conditions.items():
            if not holds:
                raise ValueError(sentence)
