"""A line of `frames.jsonl`: the acknowledgement that a frame is on the disk, and what there is to say of it."""

from __future__ import annotations

import json
from dataclasses import dataclass, fields

import cattrs


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameLine:
    """One frame of a recording but its pixels; times in s."""

    index: int  # in the recording, from 0
    camera_index: int  # the camera's own count since it was started
    camera_time_s: float  # end of the exposure on the camera's clock
    host_time_s: float  # when it had arrived, on the clock of `began_host_s` in run.json
    exposure_s: float
    em_gain: float
    is_light_on: bool | None
    light_current_a: float | None
    lost: int  # frames lost in the camera just before this one
    calibration: int | None  # number of the calibration in force
    bias: int | None  # number of the bias that corrected it
    bias_age_s: float | None  # from the frame at which it was found to this one
    start: int | None  # from whose displacement its registration began: a frame's index, BEFORE; None: cold
    problem: str  # why it was not reconstructed; empty when it was
    rms_rad: float | None  # RMS of the wavefront, mean over the views
    valid: int | None  # lenslets that yield a slope

    def to_json(self) -> str:
        """The line, without its end."""
        return json.dumps({field.name: getattr(self, field.name) for field in fields(self)}, allow_nan=False)

    @classmethod
    def from_json(cls, line: str | bytes) -> FrameLine:
        """Read a line; `ValueError` when it is damaged."""
        try:
            return _CONVERTER.structure(json.loads(line), cls)
        except (cattrs.BaseValidationError, TypeError, RecursionError) as error:
            raise ValueError("is no line of a frame") from error


_CONVERTER = cattrs.Converter()
