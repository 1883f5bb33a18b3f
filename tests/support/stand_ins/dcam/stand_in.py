"""Test control of the fake DCAM library: its clock, plug and faults."""

import ctypes
from ctypes import c_double
from enum import IntEnum
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drivers.interface import Region

_FACTOR = 40503  # of the permutation of counts; see draw() in capture.c


class Plug(IntEnum):
    """Ways to lose a camera: every call fails, frames stop silently, or only settings fail."""

    TOLD = 1
    SILENTLY = 2
    HALFWAY = 3


class StandIn:
    """Calls the stand_in_* functions of the library; after `reset` it has one camera."""

    def __init__(self, library: Path) -> None:
        self.library = library
        self._loaded = ctypes.CDLL(str(library))
        self._loaded.stand_in_now.restype = c_double
        self.reset()

    def reset(self, speed: float = 0.0) -> None:
        """Clear everything; the clock runs `speed` times real time, or at 0 jumps to awaited events."""
        self._call("reset", c_double(speed))

    def now(self) -> float:
        """Time in seconds on the cameras' clock."""
        return float(self._call("now"))

    def advance(self, duration_s: float) -> None:
        """Advance the clock at once."""
        self._call("advance", c_double(duration_s))

    def attach(self, cameras: int) -> None:
        """Attach 0, 1 or 2 cameras."""
        self._call("cameras", cameras)

    def hold(self, *, is_held: bool = True) -> None:
        """Hold the camera as another program would."""
        self._call("held", is_held)

    def unplug(self, how: Plug = Plug.TOLD, after_s: float = 0.0) -> None:
        """Pull the plug, after some time."""
        self._call("unplug", int(how), c_double(after_s))

    def plug_in(self) -> None:
        """Put the plug back; an open camera must be reopened."""
        self._call("plug_in")

    def stall(self, *, is_stalled: bool = True) -> None:
        """Send no frames, without any other fault."""
        self._call("stall", is_stalled)

    def lose(self, frames: int) -> None:
        """Lose the next frames before transfer."""
        self._call("lose", frames)

    def stop(self) -> None:
        """Stop the capture from the camera's side."""
        self._call("stop")

    def fail(self, function: str, code: int, times: int = 1, after: int = 0) -> None:
        """Make a function return an error code `times` times, after `after` successful calls."""
        self._call("fail", function.encode(), code - 2**32, times, after, of=function)

    def slow(self, function: str, duration_ms: int) -> None:
        """Delay a function; copying a frame is delayed half way down the frame."""
        self._call("slow", function.encode(), duration_ms, of=function)

    def calls(self, function: str) -> int:
        """Count the calls of a function since the reset."""
        return int(self._call("calls", function.encode(), of=function))

    def remove(self, *properties: int) -> None:
        """Remove properties from the camera."""
        for identifier in properties:
            self._call("remove", identifier)

    def refuse(self, identifier: int, code: int) -> None:
        """Make writing this property fail, until another one is named."""
        self._call("refuse", identifier, code - 2**32)

    def overexpose(self, *, is_overexposed: bool = True) -> None:
        """Expose the EM register to too much light."""
        self._call("overexpose", is_overexposed)

    def break_cooler(self, *, is_broken: bool = True) -> None:
        """Let the sensor warm up."""
        self._call("cooler_trouble", is_broken)

    def set_rounding(self, *, is_automatic: bool) -> None:
        """Round a value between two steps, or refuse it."""
        self._call("rounds", is_automatic)

    def answer_while_busy(self) -> None:
        """Answer during capture what Hamamatsu's manual says is denied: SYSTEM_ALIVE and the modes."""
        self._call("answers_while_busy", 1)

    def hide_em_gain(self) -> None:
        """Offer the EM properties with the EM amplifier only."""
        self._call("hides_em", 1)

    def set_step(self, identifier: int, step: int) -> None:
        """Give one property another step."""
        self._call("step", identifier, step)

    def trigger(self) -> None:
        """Send an external trigger."""
        self._call("trigger")

    def _call(self, name: str, *arguments: object, of: str = "") -> float:
        result: float = getattr(self._loaded, f"stand_in_{name}")(*arguments)
        if of and result < 0:
            raise ValueError(f"there is no function {of}")
        return result


def pattern(number: int, region: Region, binning: int = 1) -> NDArray[np.uint16]:
    """Frame `number` of the stand-in, (row, column); each pixel encodes its frame and its place on the sensor."""
    rows = region.top + np.arange(region.rows // binning)
    columns = region.left + np.arange(region.columns // binning)
    start = 257 * number + 12289 * rows + region.left
    count = (start & 0xFFFF)[:, np.newaxis] + columns - region.left
    pixels = (count * _FACTOR & 0xFFFF).astype(np.uint16)
    pixels[:, 0] = number & 0xFFFF
    pixels[:, 1] = number >> 16
    return pixels
