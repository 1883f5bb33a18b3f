"""The hand that moves the stand-in's world: its clock, its plug, its faults."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from enum import IntEnum
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drivers.interface import Region

_FACTOR = 40503  # of the counts' permutation; see draw() in capture.c


class Plug(IntEnum):
    """How a camera goes: every call fails, none does but no frame comes, or only reading and writing its settings."""

    TOLD = 1
    SILENTLY = 2
    HALFWAY = 3


class StandIn:
    """The library again, for what is not part of its interface; as `reset` leaves it, one camera is there."""

    def __init__(self, library: Path) -> None:
        self.library = library
        loaded = ctypes.CDLL(str(library))
        self._reset = _function(loaded, "reset", None, ctypes.c_double)
        self._now = _function(loaded, "now", ctypes.c_double)
        self._advance = _function(loaded, "advance", None, ctypes.c_double)
        self._cameras = _function(loaded, "cameras", None, ctypes.c_int32)
        self._held = _function(loaded, "held", None, ctypes.c_int32)
        self._unplug = _function(loaded, "unplug", None, ctypes.c_int32, ctypes.c_double)
        self._plug_in = _function(loaded, "plug_in", None)
        self._stall = _function(loaded, "stall", None, ctypes.c_int32)
        self._lose = _function(loaded, "lose", None, ctypes.c_int32)
        self._stop = _function(loaded, "stop", None)
        self._fail = _function(loaded, "fail", ctypes.c_int32, ctypes.c_char_p, *[ctypes.c_int32] * 3)
        self._slow = _function(loaded, "slow", ctypes.c_int32, ctypes.c_char_p, ctypes.c_int32)
        self._calls = _function(loaded, "calls", ctypes.c_int32, ctypes.c_char_p)
        self._remove = _function(loaded, "remove", None, ctypes.c_int32)
        self._refuse = _function(loaded, "refuse", None, ctypes.c_int32, ctypes.c_int32)
        self._overexpose = _function(loaded, "overexpose", None, ctypes.c_int32)
        self._cooler_trouble = _function(loaded, "cooler_trouble", None, ctypes.c_int32)
        self._rounds = _function(loaded, "rounds", None, ctypes.c_int32)
        self._trigger = _function(loaded, "trigger", None)
        self.reset()

    def reset(self, speed: float = 0.0) -> None:
        """Begin anew; the clock runs so many times faster than the machine's, or at 0 jumps to what is awaited."""
        self._reset(speed)

    def now(self) -> float:
        """Seconds on the cameras' clock."""
        return float(self._now())

    def advance(self, duration_s: float) -> None:
        """Let time pass at once."""
        self._advance(duration_s)

    def attach(self, cameras: int) -> None:
        """Have 0, 1 or 2 cameras."""
        self._cameras(cameras)

    def hold(self, *, is_held: bool = True) -> None:
        """Let another program have the camera."""
        self._held(is_held)

    def unplug(self, how: Plug = Plug.TOLD, after_s: float = 0.0) -> None:
        """Pull the plug, after some time."""
        self._unplug(how, after_s)

    def plug_in(self) -> None:
        """Put it in again; a camera that was open must be opened anew."""
        self._plug_in()

    def stall(self, *, is_stalled: bool = True) -> None:
        """Let no frame come, though nothing else is wrong."""
        self._stall(is_stalled)

    def lose(self, frames: int) -> None:
        """Lose the next frames on their way."""
        self._lose(frames)

    def stop(self) -> None:
        """Let the camera end the capture by itself."""
        self._stop()

    def fail(self, function: str, code: int, times: int = 1, after: int = 0) -> None:
        """Let a function return an error code, so many times, after so many calls that succeed."""
        _check(int(self._fail(function.encode(), code - 2**32, times, after)), function)

    def slow(self, function: str, duration_ms: int) -> None:
        """Let a function take that long; copying a frame is then slow half way down."""
        _check(int(self._slow(function.encode(), duration_ms)), function)

    def calls(self, function: str) -> int:
        """How often a function was called since the reset."""
        count = int(self._calls(function.encode()))
        _check(count, function)
        return count

    def remove(self, *properties: int) -> None:
        """Take properties away from the camera."""
        for identifier in properties:
            self._remove(identifier)

    def refuse(self, identifier: int, code: int) -> None:
        """Let writing this property fail, until another one is named."""
        self._refuse(identifier, code - 2**32)

    def overexpose(self, *, is_overexposed: bool = True) -> None:
        """Let more light in than the EM register bears."""
        self._overexpose(is_overexposed)

    def break_cooler(self, *, is_broken: bool = True) -> None:
        """Let the sensor become warm."""
        self._cooler_trouble(is_broken)

    def set_rounding(self, *, is_automatic: bool) -> None:
        """Let a value between two steps be rounded, or refused."""
        self._rounds(is_automatic)

    def trigger(self) -> None:
        """Let an external trigger arrive."""
        self._trigger()


def pattern(number: int, region: Region, binning: int = 1) -> NDArray[np.uint16]:
    """Frame `number` of the stand-in, (row, column): each pixel tells its frame and its place on the sensor."""
    rows = region.top + np.arange(region.rows // binning)
    columns = region.left + np.arange(region.columns // binning)
    start = 257 * number + 12289 * rows + region.left
    count = (start & 0xFFFF)[:, np.newaxis] + columns - region.left
    pixels = (count * _FACTOR & 0xFFFF).astype(np.uint16)
    pixels[:, 0] = number & 0xFFFF
    pixels[:, 1] = number >> 16
    return pixels


def _function(loaded: ctypes.CDLL, name: str, result: type | None, *arguments: type) -> Callable[..., float]:
    function = loaded[f"stand_in_{name}"]
    function.restype = result
    function.argtypes = arguments
    return function


def _check(code: int, function: str) -> None:
    if code < 0:
        raise ValueError(f"there is no function {function}")
