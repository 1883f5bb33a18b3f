"""Bench settings of a Hamamatsu camera: `[camera]` with driver "dcam"."""

import math
from dataclasses import dataclass
from typing import Literal

from drivers.frame import Region


@dataclass(frozen=True, slots=True, kw_only=True)
class DcamSettings:
    """Selection and settings of a DCAM camera; what is omitted keeps the camera's value.

    Opening the camera checks what depends on its mode: exposure, EM gain, binning, region.
    """

    driver: Literal["dcam"] = "dcam"
    device: str = ""  # serial number, or "0" for the first; "" takes the only one
    library: str = ""  # path of dcamapi.dll or libdcamapi.so if not installed in the standard place
    pixel_pitch_m: float | None = None  # of the sensor, if the camera does not report it
    amplifier: Literal["normal", "em"] | None = None
    readout_speed: int | None = None  # from 1, the slowest; limits the exposure; the normal amplifier has only 1
    exposure_s: float | None = None
    em_gain: float | None = None
    em_gain_protection: bool = True  # black frames instead of too much light, which ages the EM register
    em_gain_protection_frames: int | None = None  # with too much light, before it acts
    em_gain_warning_level: int | None = None  # 1 ... 3, the most sensitive
    binning: int = 1
    region: Region | None = None  # the whole sensor
    trigger: Literal["internal", "external", "software"] = "internal"
    trigger_active: Literal["edge", "level", "synchronous"] | None = None
    trigger_polarity: Literal["negative", "positive"] | None = None
    trigger_delay_s: float | None = None
    output: Literal["low", "exposure", "programmable", "trigger ready", "high"] | None = None  # of the first connector
    output_polarity: Literal["negative", "positive"] | None = None
    cooler: Literal["off", "on", "max"] | None = None
    ring_frames: int = 128  # buffered before the oldest is overwritten

    def __post_init__(self) -> None:
        delay_s, level, frames = self.trigger_delay_s, self.em_gain_warning_level, self.em_gain_protection_frames
        conditions = {
            f"{key} must be positive": value is None or 0 < value < math.inf
            for key, value in (("pixel_pitch_m", self.pixel_pitch_m), ("exposure_s", self.exposure_s))
        } | {
            "readout_speed must be at least 1": self.readout_speed is None or self.readout_speed >= 1,
            "em_gain must be 0 or positive": self.em_gain is None or 0 <= self.em_gain < math.inf,
            'em_gain needs amplifier = "em"': self.em_gain is None or self.em_gain == 1 or self.amplifier != "normal",
            "em_gain_protection_frames must be 1 ... 255": frames is None or 1 <= frames <= 255,
            "em_gain_warning_level must be 1, 2 or 3": level is None or 1 <= level <= 3,
            "binning must be 1 ... 16": 1 <= self.binning <= 16,
            "trigger_delay_s must be 0 or positive": delay_s is None or 0 <= delay_s < math.inf,
            "ring_frames must be 4 ... 10000": 4 <= self.ring_frames <= 10000,
        }
        for sentence, holds in conditions.items():
            if not holds:
                raise ValueError(sentence)
