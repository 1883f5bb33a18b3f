"""Hamamatsu cameras over the DCAM-API: their settings."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Literal

from annotated_types import Ge, Le
from typing_extensions import Doc

from drivers.camera import ExposureSetting, PitchSetting, RegionSetting

Output = Literal["low", "exposure", "programmable", "trigger ready", "high"]


@dataclass(frozen=True, slots=True, kw_only=True)
class DcamSettings:
    """Selection and settings of a DCAM camera; omitted ones keep its value. Opening checks what depends on its mode."""

    driver: Literal["dcam"] = "dcam"
    device: Annotated[str, Doc('Serial number, or "0" for the first; empty takes the only one')] = ""
    library: Annotated[str, Doc("Path of dcamapi.dll or libdcamapi.so if not installed in the standard place")] = ""
    pixel_pitch_m: PitchSetting | None = None
    amplifier: Literal["normal", "em"] | None = None
    readout_speed: Annotated[int, Ge(1), Le(100), Doc("Readout speed; with the normal amplifier 1")] | None = None
    exposure_s: ExposureSetting | None = None
    em_gain: Annotated[float, Ge(0), Le(1e5)] | None = None
    em_gain_protection: Annotated[bool, Doc("Protection of the EM register: black frames in too much light")] = True
    em_gain_protection_frames: Annotated[int, Ge(1), Le(255), Doc("Number of too bright frames allowed")] | None = None
    em_gain_warning_level: Annotated[int, Ge(1), Le(3), Doc("Warning level; 3 is the most sensitive")] | None = None
    binning: Annotated[int, Ge(1), Le(16)] = 1
    region: RegionSetting | None = None
    trigger: Literal["internal", "external"] = "internal"
    trigger_active: Literal["edge", "level", "synchronous"] | None = None
    trigger_polarity: Literal["negative", "positive"] | None = None
    trigger_delay_s: Annotated[float, Ge(0), Le(86_400)] | None = None
    output: Annotated[Output, Doc("Signal at the first output")] | None = None
    output_polarity: Literal["negative", "positive"] | None = None
    cooler: Literal["off", "on", "max"] | None = None
    ring_frames: Annotated[int, Ge(4), Le(10000), Doc("Frames buffered before the oldest is overwritten")] = 128

    def faults(self) -> Iterator[tuple[str, str]]:
        """Yield settings that contradict others, and why."""
        if self.em_gain not in {None, 1} and self.amplifier == "normal":
            yield "em_gain", 'needs amplifier = "em"'
