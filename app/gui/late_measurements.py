"""Redraws that the window leaves out, so that a late measurement gets the processor."""

from app.acquisition.worker import Measurement

_LATE = 1.5  # times between two frames until a result: beyond, frames are waiting
_REDRAWS = 2  # at least, between two that are left out


class LateMeasurements:
    """Gives way to late measurements with one redraw of three."""

    def __init__(self) -> None:
        self._redraws = 0  # since one was left out

    def leave_out(self, newest: Measurement, shown: Measurement | None) -> bool:
        """Return whether to leave out the redraw of the newest measurement; another one is `shown` now."""
        if self._redraws >= _REDRAWS and shown is not None and _is_late(newest, shown):
            self._redraws = 0
            return True
        self._redraws += 1
        return False


def _is_late(newest: Measurement, shown: Measurement) -> bool:
    frames = newest.counts.acquired - shown.counts.acquired
    if frames <= 0:  # the camera was started again
        return False
    between_s = (newest.frame.host_time_s - shown.frame.host_time_s) / frames
    return newest.latency_s > _LATE * max(between_s, newest.frame.exposure_s)
