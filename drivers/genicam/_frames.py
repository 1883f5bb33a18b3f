"""Frames of a GenICam camera: pixel formats and indices."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Container
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

_LAST_SHORT_ID = 65535  # GigE Vision counts frames 1 ... 65535, then 1 again; some cameras count 0 ... 65535
_NEAR_WRAP = 1024  # frames that may be lost across a wrap; a number that falls back by less has begun again


@dataclass(slots=True)
class FrameCount:
    """Frame index since start, including lost frames, from the camera's frame numbers."""

    index: int = -1  # of the last frame
    _last_id: int = 0
    _last_s: float = math.nan
    _shortest_s: float = 0.0  # between two frames; 0: not known

    def advance(self, frame_id: int, sent_s: float = math.nan) -> int:
        """Return the index of the frame with this number, sent then; the first has index 0."""
        elapsed_s, step = sent_s - self._last_s, frame_id - self._last_id
        if self.index < 0:
            step = 1
        elif step <= 0:  # only short numbers wrap around; others repeat or begin again
            step %= _LAST_SHORT_ID + (frame_id == 0)
            is_wrap = self._last_id <= _LAST_SHORT_ID and 0 < step < _NEAR_WRAP
            # there was no time for the frames that would be lost: the camera has begun again near the last number
            if not is_wrap or elapsed_s < step * self._shortest_s / 2:
                step = 1
        if elapsed_s > 0:
            self._shortest_s = min(self._shortest_s or math.inf, elapsed_s / step)
        self.index, self._last_id, self._last_s = self.index + step, frame_id, sent_s
        return self.index


ByteOrder = Literal["little", "big"]
# Models that send 16-bit pixels big-endian, whatever their features say. Aravis never swaps bytes; since 0.8.32 it
# only names the order for GStreamer. Source: github.com/AravisProject/aravis, issues 921 and 1029, pull request 924.
_BIG_ENDIAN_MODELS: Final = ("BFLY-PGE", "A305sc", "A320G")


@dataclass(frozen=True, slots=True)
class PixelFormat:
    """A format of the Pixel Format Naming Convention (PFNC) or of GigE Vision."""

    name: str
    bits: int
    packing: Literal["none", "pfnc", "gige"] = "none"

    @property
    def full_scale(self) -> int:
        """Largest count."""
        return (1 << self.bits) - 1

    def size_bytes(self, pixels: int) -> int:
        """Bytes of so many pixels without padding."""
        bits = self.bits if self.packing == "pfnc" else 12 if self.packing == "gige" else 8 * math.ceil(self.bits / 8)
        return math.ceil(pixels * bits / 8)

    def unpack(self, stored: NDArray[np.uint8], pixels: int, byte_order: ByteOrder) -> NDArray[np.uint16]:
        """Return the counts, shape (pixels,), of stored bytes; always a copy."""
        if self.packing == "none":
            sent: np.dtype[Any] = np.dtype("u1" if self.bits == 8 else ">u2" if byte_order == "big" else "<u2")
            return stored.view(sent)[:pixels].astype(np.uint16)
        return (_unpack_pfnc if self.packing == "pfnc" else _unpack_gige)(stored, pixels, self.bits)


_FORMATS: Final = (
    PixelFormat("Mono16", 16),
    PixelFormat("Mono14", 14),
    PixelFormat("Mono12", 12),
    PixelFormat("Mono12p", 12, "pfnc"),
    PixelFormat("Mono12Packed", 12, "gige"),
    PixelFormat("Mono10", 10),
    PixelFormat("Mono10p", 10, "pfnc"),
    PixelFormat("Mono10Packed", 10, "gige"),
    PixelFormat("Mono8", 8),
)
PIXEL_FORMATS: Final = {pixel_format.name: pixel_format for pixel_format in _FORMATS}


def preferred_format(offered: Container[str], digitiser_bits: int | None) -> PixelFormat | None:
    """Return the format that keeps all bits of the digitiser and pads least; None if none is grey.

    Padded bits hide saturation, because the camera may put the data into the high or the low ones. If the camera does
    not report its digitiser, that has the depth of the deepest format below 16 bits.
    """
    usable = [pixel_format for name, pixel_format in PIXEL_FORMATS.items() if name in offered]
    depths = [pixel_format.bits for pixel_format in usable if 8 < pixel_format.bits < 16]
    kept = digitiser_bits or max(depths, default=16)
    return max(usable, key=lambda each: (min(each.bits, kept), -each.bits), default=None)  # the first of equal ones


def byte_order_of(model: str, *, is_reported_big: bool) -> ByteOrder:
    """Return the byte order of unpacked 16-bit pixels."""
    return "big" if is_reported_big or any(part in model for part in _BIG_ENDIAN_MODELS) else "little"


@dataclass(slots=True)
class Saturation:
    """The count at which a pixel saturates, found from the bits that the camera uses.

    Left-aligned data are multiples of a power of two: 12 bits in Mono16 end at 65520. Right-aligned data never reach
    the high bits; that shows only if the camera reports the depth of its digitiser.
    """

    pixel_format: PixelFormat
    digitiser_bits: int | None = None
    reported: int | None = None  # by the camera: PixelDynamicRangeMax
    _used: int = 0  # bitwise or of all counts so far

    def observe(self, pixels: NDArray[np.uint16]) -> None:
        """Take the used bits of a frame, counts (row, column), into account."""
        self._used |= int(np.bitwise_or.reduce(pixels, axis=None))

    @property
    def counts(self) -> int:
        """Count at which a pixel saturates, as far as known."""
        depth, used = self.pixel_format.bits, self._used
        lowest = used & -used  # 0 before the first frame with light
        padding = depth - min(self.digitiser_bits or depth, depth)
        if lowest and lowest < 1 << padding and used < 1 << (depth - padding):
            return (1 << (depth - padding)) - 1  # right-aligned
        most = self.pixel_format.full_scale
        if 1 < lowest <= 1 << (depth - 8):  # left-aligned, 8 bits or more
            most -= lowest - 1
        if self.reported and self.reported.bit_length() >= used.bit_length():
            most = min(most, self.reported)
        return most


def copied_pixels(
    address: int, shape: tuple[int, int], *, row_padding_bytes: int, pixel_format: PixelFormat, byte_order: ByteOrder
) -> NDArray[np.uint16]:
    """Return a read-only copy of the pixels at the address, counts, of this shape (row, column)."""
    rows, columns = shape
    if row_padding_bytes:
        row_bytes = pixel_format.size_bytes(columns)
        stored = _bytes_at(address, rows * (row_bytes + row_padding_bytes)).reshape(rows, -1)
        lines = [pixel_format.unpack(line[:row_bytes], columns, byte_order) for line in stored]
        pixels = np.array(lines, np.uint16)
    else:
        stored = _bytes_at(address, pixel_format.size_bytes(rows * columns))
        pixels = pixel_format.unpack(stored, rows * columns, byte_order).reshape(rows, columns)
    pixels.flags.writeable = False
    return pixels


def _bytes_at(address: int, size: int) -> NDArray[np.uint8]:
    return np.frombuffer(memoryview((ctypes.c_ubyte * size).from_address(address)), np.uint8)


def _unpack_pfnc(stored: NDArray[np.uint8], pixels: int, bits: int) -> NDArray[np.uint16]:
    """Unpack Mono10p or Mono12p to (pixels,): one stream of bits, lowest first."""
    together = 8 // math.gcd(bits, 8)  # pixels that fill whole bytes
    groups = _grouped(stored, together * bits // 8)
    counts = np.empty((len(groups), together), np.uint16)
    for i in range(together):
        byte, shift = divmod(i * bits, 8)
        low, high = groups[:, byte].astype(np.uint16), groups[:, byte + 1].astype(np.uint16)
        counts[:, i] = (low | high << 8) >> shift & ((1 << bits) - 1)
    return counts.ravel()[:pixels]


def _unpack_gige(stored: NDArray[np.uint8], pixels: int, bits: int) -> NDArray[np.uint16]:
    """Unpack Mono10Packed or Mono12Packed to (pixels,): two high bytes around one of low bits."""
    first, low, second = _grouped(stored, 3).astype(np.uint16).T
    more = bits - 8
    counts = np.empty((len(low), 2), np.uint16)
    counts[:, 0] = first << more | low & ((1 << more) - 1)
    counts[:, 1] = second << more | low >> 4 & ((1 << more) - 1)
    return counts.ravel()[:pixels]


def _grouped(stored: NDArray[np.uint8], size: int) -> NDArray[np.uint8]:
    """Bytes in groups, (groups, size); zeros fill the last one."""
    missing = -len(stored) % size
    return (np.pad(stored, (0, missing)) if missing else stored).reshape(-1, size)
