"""Waiting for frames, and the ways a routine ends early."""

import time
from collections.abc import Callable

from app.errors import RunError
from drivers.interface import Camera, DeviceTimeout, Frame, FrameLost

FrameProgress = Callable[[Frame, float], None]  # newest frame, fraction done 0 ... 1
ShouldStop = Callable[[], bool]

WAIT_SLICE_S = 0.1  # longest wait, so that a stop takes effect at once even in a long exposure
_MARGIN_S = 3.0  # timeout beyond the exposure


class Cancelled(Exception):
    """The routine was asked to stop."""


class RoutineError(RunError):
    """A routine cannot reach its goal, although no device failed; the text says what to do."""


def next_frame(camera: Camera, should_stop: ShouldStop) -> Frame:
    """Wait for the next frame in slices; raise `Cancelled` on a stop, `DeviceTimeout` if none arrives.

    Lost frames are skipped; they show as a gap in the frame index.
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
                raise DeviceTimeout(f"no complete frame has arrived for too long: {error}") from error
