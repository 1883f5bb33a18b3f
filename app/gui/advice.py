"""What to say when nothing is the matter, and what to do when something is."""

from __future__ import annotations

import time

from app.acquisition.instrument import Status
from app.acquisition.worker import Activity, Measurement

_SLOW_S = 1.0  # a frame that is shown for longer is explained


def warning(status: Status, problem: str) -> str:
    """Why wavefronts are missing or doubtful, with the keys that take what is stale anew; empty when they are not.

    A `problem` of the newest frame comes first.
    """
    if problem not in {"", status.warning}:
        return problem
    stale = (("D: dark", status.dark), ("R: reference", status.reference))
    keys = ", ".join(key for key, standing in stale if standing != "good")
    return f"{status.warning}  ({keys})" if status.warning and keys else status.warning


def advice(status: Status | None, activity: Activity, measurement: Measurement | None) -> str:
    """Say what is under way, or what the user might do next."""
    if activity.text:
        return f"{activity.text}: Esc cancels" if status is not None else activity.text
    if status is None:
        return ""
    if not status.is_running:
        return "the camera is stopped: Space starts it"
    if (
        measurement is not None
        and time.perf_counter() - measurement.frame.host_time_s > _SLOW_S + 2 * status.exposure_s
    ):
        return "the next frame is still being reconstructed; whatever is asked for now is done after it"
    return "F1 shows keys and conventions"
