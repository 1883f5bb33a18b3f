"""Waiting for frames, and how a routine ends early."""

from __future__ import annotations

import time
from collections.abc import Callable

from app.errors import RunError
from drivers.interface import Camera, DeviceTimeout, Frame, FrameLost

Progress = Callable[[Frame, float], None]  # the frame that has come, and how much is done, 0 ... 1
ShouldStop = Callable[[], bool]

WAIT_SLICE_S = 0.1  # no wait is longer, so that a stop takes effect at once even in a long exposure
_MARGIN_S = 3.0  # beyond the exposure, before a missing frame counts as a fault


class Cancelled(Exception):
    """Somebody asked the routine to stop."""


class RoutineError(RunError):
    """A routine cannot reach its goal though no device is at fault; the text says what to do at the bench."""


def next_frame(camera: Camera, should_stop: ShouldStop) -> Frame:
    """Wait for the next frame in slices; raise `Cancelled` when asked to stop, `DeviceTimeout` when none comes.

    One that was lost on its way is passed over: the gap in the numbers tells of it.
    """
    deadline_s = time.monotonic() + camera.exposure_s + _MARGIN_S
    while True:
        if should_stop():
            raise Cancelled
        try:
            return camera.read(WAIT_SLICE_S)
        except DeviceTimeout:
            if time.monotonic() > deadline_s:
                raise
        except FrameLost as error:
            if time.monotonic() > deadline_s:
                raise DeviceTimeout(f"no whole frame has come for long: {error}") from error
