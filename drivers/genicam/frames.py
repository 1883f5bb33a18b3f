"""From what a GenICam camera sends to a frame: pixel formats, the numbers of the frames, the pixels themselves."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

_LAST_SHORT_ID = 65535  # GigE Vision counts frames 1 ... 65535, then 1 again; 0 is never used


@dataclass(frozen=True, slots=True)
class PixelFormat:
    """Grey pixels as GenICam's Pixel Format Naming Convention has them, unpacked, in the low bits of whole bytes."""

    bits: int

    @property
    def full_scale(self) -> int:
        """The largest count."""
        return (1 << self.bits) - 1

    @property
    def stored(self) -> np.dtype[Any]:
        """How a pixel comes."""
        return np.dtype("u1") if self.bits == 8 else np.dtype("<u2")


# the deepest first
PIXEL_FORMATS = {f"Mono{bits}": PixelFormat(bits) for bits in (16, 14, 12, 10, 8)}


@dataclass(slots=True)
class FrameCount:
    """Counts the frames since the start, those that did not arrive with them, from the camera's own numbers."""

    index: int = -1  # of the last frame
    _last_id: int = 0

    def advance(self, frame_id: int) -> int:
        """Return the index of the frame that came with this number; the first has index 0."""
        if self.index < 0:
            self.index = 0
        elif frame_id > self._last_id:
            self.index += frame_id - self._last_id
        else:  # only the short numbers begin anew
            self.index += (frame_id - self._last_id) % _LAST_SHORT_ID
        self._last_id = frame_id
        return self.index


@dataclass(slots=True)
class ExposureLog:
    """Which exposure time a frame has, when the time was changed while the camera ran."""

    _changes: list[tuple[float, float]]  # when (s), and the exposure in force from then on

    @classmethod
    def beginning_with(cls, exposure_s: float) -> ExposureLog:
        """A run that begins with this exposure."""
        return cls([(-np.inf, exposure_s)])

    def change(self, now_s: float, exposure_s: float) -> None:
        """From `now_s` on, exposures that begin are of another length."""
        self._changes.append((now_s, exposure_s))

    def of_frame(self, sent_s: float) -> float:
        """Return the exposure of the frame that was sent then: the newest that could begin and end before."""
        newest = max(i for i, (since_s, exposure_s) in enumerate(self._changes) if since_s + exposure_s <= sent_s)
        del self._changes[:newest]
        return self._changes[0][1]


def copied_pixels(address: int, rows: int, columns: int, pixel_format: PixelFormat) -> NDArray[np.uint16]:
    """Return the pixels at the address as (rows, columns) counts of their own, read-only."""
    size = rows * columns * pixel_format.stored.itemsize
    stored = np.frombuffer(memoryview((ctypes.c_ubyte * size).from_address(address)), pixel_format.stored)
    pixels: NDArray[np.uint16] = stored.reshape(rows, columns).astype(np.uint16)
    pixels.flags.writeable = False
    return pixels
