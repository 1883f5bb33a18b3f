"""Section `[camera]` with driver "recording": a recording in place of the devices."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Pace = Literal["own", "fastest"]


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingSettings:
    """Recording to play, and its pace."""

    driver: Literal["recording"] = "recording"
    folder: str
    pace: Pace = "own"  # as recorded; "fastest": each frame when it is read, so that none is skipped
    repeat: bool = False  # start again after the last frame; otherwise no more frames come
