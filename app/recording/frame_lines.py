"""The lines of `frames.jsonl`, one for each frame."""

from __future__ import annotations

import json
import math
import zlib
from dataclasses import asdict, dataclass
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from reconstruction.layers.layered_wavefront import FREE, AssumedSample

if TYPE_CHECKING:
    from pydantic import TypeAdapter

_LATEST_S = 1e12  # of a sound line
UNREADABLE = b"{}\n"  # replaces a line that cannot be read, so that the others keep their places


@dataclass(frozen=True, slots=True)
class SampleLine:
    """Sample assumed for a frame; see `AssumedSample`."""

    ratios: tuple[float, ...]
    covariance: tuple[tuple[float, ...], ...] | None
    rivals: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        layers, rows = len(self.ratios), self.covariance or ()
        is_square = self.covariance is None or [len(row) for row in rows] == [layers] * layers
        numbers = *self.ratios, *self.rivals, *(value for row in rows for value in row)
        if not is_square or not all(map(math.isfinite, numbers)):
            raise ValueError(f"layers at the ratios {', '.join(map(str, self.ratios))} are impossible")


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameLine:
    """One frame of a recording without its pixels; times in s."""

    index: int  # in the recording, from 0
    camera_index: int  # the camera's own count since its start
    camera_time_s: float  # end of the exposure on the camera's clock
    host_time_s: float  # arrival, on the clock of `began_host_s` in run.json
    exposure_s: float
    em_gain: float
    is_light_on: bool | None
    light_current_a: float | None
    lost: int  # frames that the camera lost just before this one
    calibration: int | None  # number of the calibration in force
    bias: int | None  # number of the bias that was subtracted
    bias_age_s: float | None  # from the frame that gave the bias to this one
    problem: str  # why it was not reconstructed; empty if it was
    rms_rad: float | None  # RMS of the wavefront, mean over the views
    valid: int | None  # lenslets that yield a slope
    sample: SampleLine | None = None  # None: any wavefront, because no sample was found yet
    crc32: str | None = None  # `checksum` of the pixels; None before version 0.3
    gap_s: float = 0.0  # for which the camera stood just before this frame
    gap_cause: str = ""
    absorbs: bool | None = None  # whether it was registered as behind a sample that absorbs; None: not registered

    def to_json(self) -> str:
        """Return the line without its newline."""
        fields = {name: getattr(self, name) for name in self.__slots__}
        if self.sample is not None:
            fields["sample"] = asdict(self.sample)
        return json.dumps(fields, allow_nan=False)

    @classmethod
    def from_json(cls, line: str | bytes) -> FrameLine:
        """Read a line; `ValueError` if it is damaged."""
        found = _reader().validate_json(line)
        times_s = found.camera_time_s, found.host_time_s, found.exposure_s, found.bias_age_s or 0.0
        if min(found.exposure_s, found.em_gain) < 0 or not all(abs(each) < _LATEST_S for each in times_s):  # nor NaN
            raise ValueError("exposure, gain or times are impossible")
        return found


def checksum(pixels: NDArray[np.uint16]) -> str:
    """CRC-32 of pixels, (row, column) as they are stored, in eight hexadecimal digits."""
    return f"{zlib.crc32(np.ascontiguousarray(pixels, '<u2').data):08x}"


@cache
def _reader() -> TypeAdapter[FrameLine]:
    from pydantic import TypeAdapter

    return TypeAdapter(FrameLine)


def sample_line(sample: AssumedSample) -> SampleLine:
    """Form of a sample in the line of a frame, from which `assumed_sample` restores it exactly."""
    covariance = None if sample.covariance is None else tuple(map(tuple, sample.covariance.tolist()))
    return SampleLine(sample.ratios, covariance, sample.rivals)


def assumed_sample(line: SampleLine | None) -> AssumedSample:
    """Sample of a line; any wavefront before one was found."""
    if line is None or not line.ratios:
        return FREE
    covariance = None if line.covariance is None else np.array(line.covariance)
    return AssumedSample(line.ratios, covariance, line.rivals)
