"""Situation of the shown frame: whether it is live, and what the window says of it."""

import math
import time
from typing import NamedTuple

from app.acquisition.instrument import Status
from app.acquisition.worker import Activity, Measurement
from app.gui.wording import conditions_of, is_old, is_replay, stale, warning


class Liveness(NamedTuple):
    """How a shown frame differs from a live one; empty if it does not."""

    badge: str = ""
    reason: str = ""
    is_grey: bool = False  # whether the bench may differ from what is shown by now


class Situation:
    """Follows status and failure of the acquisition."""

    def __init__(self) -> None:
        self._conditions: tuple[object, ...] = ()  # of the frames
        self._changed_s = -math.inf  # time of their last change

    def follow(self, status: Status) -> None:
        """Note when the conditions of the frames change: what is wrong with earlier frames is over then."""
        if (conditions := conditions_of(status)) != self._conditions:
            self._conditions, self._changed_s = conditions, time.perf_counter()

    def alarm(self, status: Status | None, activity: Activity, measurement: Measurement | None) -> str:
        """Return why wavefronts are missing or doubtful; empty during an activity, and if all is well."""
        if status is None or activity.text:
            return ""
        is_present = measurement is not None and measurement.exposure_end_s >= self._changed_s
        if measurement is None or not status.is_running or not is_present:
            return warning(status)
        return warning(status, measurement.problem, measurement.wavefront, measurement.quality)


def liveness(status: Status | None, failure: str, activity: Activity, measurement: Measurement | None) -> Liveness:
    """Return how the shown frame differs from a live one."""
    if status is None or measurement is None:
        waits = activity.text or failure
        return Liveness("WAITING" if waits else "", waits, is_grey=bool(waits))
    age_s = time.perf_counter() - measurement.exposure_end_s
    age = f"{age_s:.0f} s" if age_s < 100 else f"{age_s / 60:.0f} min"
    if measurement.file:
        return Liveness(f"FILE {measurement.file}", "Space returns to the camera")
    if is_replay(status):
        return Liveness("REPLAY", status.camera_name)
    if failure:
        return Liveness(f"DISCONNECTED, {age} old", failure, is_grey=True)
    is_stopped = not status.is_running and not activity.text
    if is_stopped or (is_old(measurement) and age_s > 3 * measurement.latency_s):  # a slow method is always late
        why = "the camera is stopped: Space starts it" if is_stopped else "no newer frame has come yet"
        return Liveness(f"PAUSED, {age} old", activity.text or why, is_grey=True)
    reason = stale(status)
    return Liveness("STALE" if reason else "", reason, is_grey=bool(reason))
