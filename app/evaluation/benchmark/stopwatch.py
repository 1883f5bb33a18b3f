"""Times of several calls in turn, so that other load on the computer slows all of them alike."""

import time
from collections.abc import Callable, Mapping
from typing import Any

import xarray as xr

from app.evaluation.cases import REPEAT, CaseResult, collect, rows
from app.progress import Progress

_TURN_S = 0.02  # minimum duration of a turn; quicker calls are repeated
_LEAST_CALLS = 3


def side_by_side(
    calls: Mapping[str, Callable[[], Any]], budget_s: float, progress: Progress = lambda *_: None
) -> xr.Dataset:
    """Call everything in turn until each has had `budget_s` and three calls.

    Returns `seconds` (contestant, repeat); the first call of each may compile or load something and is not timed.
    """
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    for index, (name, call) in enumerate(calls.items()):
        progress(name, index / len(calls) / 2)
        call()
    waiting = dict(calls)
    while waiting:
        for name, call in list(waiting.items()):
            progress(name, 1 - len(waiting) / len(calls) / 2)
            turn_s = 0.0
            while turn_s < _TURN_S:
                start_s = time.perf_counter()
                call()
                seconds[name].append(time.perf_counter() - start_s)
                turn_s += seconds[name][-1]
            if sum(seconds[name]) >= budget_s and len(seconds[name]) >= _LEAST_CALLS:
                del waiting[name]
    named = ((name, each) for name, all_s in seconds.items() for each in all_s)
    return collect(
        ("contestant",), (CaseResult(at={"contestant": name}, values={"seconds": each}) for name, each in named)
    )


def summaries(times: xr.Dataset) -> dict[str, dict[str, float]]:
    """Return median and best time, s, and the number of calls by contestant."""
    seconds = times["seconds"]
    summary = {"median_s": seconds.median(REPEAT), "best_s": seconds.min(REPEAT), "calls": seconds.count(REPEAT)}
    return {row.pop("contestant"): row for row in rows(xr.Dataset(summary), ("contestant",))}


def medians_s(times: xr.Dataset) -> dict[str, float]:
    """Return the median time, s, by contestant."""
    return {name: summary["median_s"] for name, summary in summaries(times).items()}
