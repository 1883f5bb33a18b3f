"""The lines of `frames.jsonl`, one for each frame, and the search for them after damage."""

from __future__ import annotations

import json
import math
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

import cattrs
import numpy as np
from numpy.typing import NDArray

from reconstruction.layers.layered_wavefront import FREE, AssumedSample

_DIGITS = 18  # of whole numbers, so that they fit into 64 bits
_LATEST_S = 1e11  # camera clocks count 64 bits of ns at most
UNREADABLE = b"{}\n"  # replaces a line that cannot be read, so that the others keep their places


@dataclass(frozen=True, slots=True)
class SampleLine:
    """Sample assumed for a frame; see `AssumedSample`."""

    ratios: tuple[float, ...]
    covariance: tuple[tuple[float, ...], ...] | None


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
    start: int | None  # frame whose displacement was the starting point, or BEFORE; None: none
    problem: str  # why it was not reconstructed; empty if it was
    rms_rad: float | None  # RMS of the wavefront, mean over the views
    valid: int | None  # lenslets that yield a slope
    sample: SampleLine | None = None  # None: any wavefront, because no sample was found yet
    crc32: str | None = None  # `checksum` of the pixels; None before version 0.3
    gap_s: float = 0.0  # for which the camera stood just before this frame
    gap_cause: str = ""

    def to_json(self) -> str:
        """Return the line without its newline."""
        return json.dumps(asdict(self), allow_nan=False)

    @classmethod
    def from_json(cls, line: str | bytes) -> FrameLine:
        """Read a line; `ValueError` if it is damaged."""
        try:
            tree = json.loads(line, parse_constant=_refuse, parse_int=_whole)
            found = _CONVERTER.structure(tree, cls)
        except (cattrs.BaseValidationError, TypeError, RecursionError) as error:
            raise ValueError("not the line of a frame") from error
        times_s = (found.camera_time_s, found.host_time_s, found.bias_age_s or 0.0)
        if found.exposure_s < 0 or found.em_gain < 0 or max(map(abs, (*times_s, found.exposure_s))) > _LATEST_S:
            raise ValueError("exposure, gain or times are impossible")
        return found


def checksum(pixels: NDArray[np.uint16]) -> str:
    """CRC-32 of pixels, (row, column) as they are stored, in eight hexadecimal digits."""
    return f"{zlib.crc32(np.ascontiguousarray(pixels, '<u2').data):08x}"


_CONVERTER = cattrs.Converter()


def _refuse(constant: str) -> float:
    raise ValueError(f"{constant} is no number")


def _whole(digits: str) -> int:
    if len(digits) > _DIGITS:
        raise ValueError("too large")
    return int(digits)


@dataclass(frozen=True, slots=True)
class FoundLines:
    """Positions of the readable lines. A lost block of the disk shifts all later lines."""

    path: Path
    spans: Mapping[int, tuple[int, int]]  # first byte and end of each frame's line
    unreadable: frozenset[int]  # first byte of each `UNREADABLE`

    def line(self, index: int) -> FrameLine | None:
        """The line of a frame; None if it cannot be read."""
        return FrameLine.from_json(_text(self.path, *self.spans[index])) if index in self.spans else None

    def end_in_place(self, frames: int) -> int | None:
        """End of the first `frames` lines if each is in its place, else None."""
        end = 0
        for index in range(frames):
            begin, after = self.spans.get(index, (end, end + len(UNREADABLE)) if end in self.unreadable else (-1, -1))
            if begin != end:
                return None
            end = after
        return end

    def in_place(self, frames: int) -> Iterator[bytes]:
        """The first `frames` lines, each in its place."""
        with self.path.open("rb") as file:
            for index in range(frames):
                begin, end = self.spans.get(index, (0, 0))
                file.seek(begin)
                yield file.read(end - begin) or UNREADABLE


def find_lines(path: Path) -> FoundLines:
    """Find every readable line; if two different ones have the same index, neither counts."""
    spans: dict[int, tuple[int, int]] = {}
    unreadable, ambiguous = set(), set()
    with path.open("rb") as file:
        end = 0
        for text in file:
            begin, end = end, end + len(text)
            if text == UNREADABLE:
                unreadable.add(begin)
            elif text.endswith(b"\n") and (index := _index_of(text)) is not None:
                first = spans.setdefault(index, (begin, end))
                if first != (begin, end) and _text(path, *first) != text:
                    ambiguous.add(index)
    sure = {index: span for index, span in spans.items() if index not in ambiguous}
    return FoundLines(path, sure, frozenset(unreadable))


def _text(path: Path, begin: int, end: int) -> bytes:
    with path.open("rb") as file:
        file.seek(begin)
        return file.read(end - begin)


def _index_of(text: bytes) -> int | None:
    try:
        return FrameLine.from_json(text).index
    except ValueError:
        return None


_MOST_LAYERS, _MOST_RATIO = 2, 1e4  # in a sound line


def sample_line(sample: AssumedSample) -> SampleLine:
    """Form of a sample in the line of a frame, from which `assumed_sample` restores it exactly."""
    covariance = None if sample.covariance is None else tuple(map(tuple, sample.covariance.tolist()))
    return SampleLine(sample.ratios, covariance)


def assumed_sample(line: SampleLine) -> AssumedSample:
    """Sample of a line; `ValueError` if no search can have found it."""
    if not line.ratios:
        return FREE
    numbers, layers = [*line.ratios, *(value for row in line.covariance or () for value in row)], len(line.ratios)
    is_sound = (
        layers <= _MOST_LAYERS
        and len(set(line.ratios)) == layers
        and all(map(math.isfinite, numbers))
        and max(map(abs, line.ratios)) <= _MOST_RATIO
        and (line.covariance is None or [len(row) for row in line.covariance] == [layers] * layers)
    )
    if not is_sound:
        raise ValueError(f"layers at the ratios {', '.join(map(str, line.ratios))} are impossible")
    return AssumedSample(line.ratios, None if line.covariance is None else np.array(line.covariance))
