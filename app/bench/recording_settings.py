"""What a bench's TOML says of a recording that takes the place of its devices: `[camera]` with driver "recording"."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Pace = Literal["own", "fastest"]


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingSettings:
    """Which recording is played, and how."""

    driver: Literal["recording"] = "recording"
    folder: str
    pace: Pace = "own"  # as its frames came; "fastest": each as soon as it is waited for, so that none is passed over
    repeat: bool = False  # from the first frame again after the last; else there is no further frame
