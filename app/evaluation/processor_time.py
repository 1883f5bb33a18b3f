"""Processor time and memory of this process and of all that descend from it; only Linux knows those of each thread."""

from __future__ import annotations

import os
import sys
from collections import defaultdict
from collections.abc import Iterator
from contextlib import suppress

import psutil

RENDERING, INSTRUMENT, WINDOW, DETECTOR = "simulated rendering", "instrument", "window", "detector"
Times = dict[str, dict[str, float]]  # seconds of each thread by process; the thread "" represents the whole process
_PROCESSES = {  # by a part of the command line
    "render_missing": RENDERING,
    "background_estimator": "background estimator",
    "watchdog": "watchdog",
    " serve ": INSTRUMENT,
}


def processor_times(since: Times | None = None) -> Times:
    """Return the processor time of each process and thread so far, or since an earlier answer."""
    seconds: defaultdict[str, dict[str, float]] = defaultdict(dict)
    for process, name in _processes():
        taken = defaultdict[str, float](float)
        with suppress(psutil.Error):  # it has just ended
            taken[""] = sum(process.cpu_times()[:2])
            for thread in process.threads() if sys.platform == "linux" else ():
                with suppress(psutil.Error):
                    own = "main" if thread.id == process.pid else psutil.Process(thread.id).name()
                    taken[own] += thread.user_time + thread.system_time
        for thread_name, taken_s in taken.items():
            seconds[name][thread_name] = seconds[name].get(thread_name, 0.0) + taken_s
    earlier = since or {}
    return {
        process: {thread: max(end - earlier.get(process, {}).get(thread, 0.0), 0.0) for thread, end in threads.items()}
        for process, threads in seconds.items()
    }


def memory_mb() -> dict[str, float]:
    """Return the memory by process, MB of 2**20 bytes, what they share in equal parts (PSS); {}: unknown."""
    found: defaultdict[str, float] = defaultdict(float)
    for process, name in _processes():
        with suppress(psutil.Error, AttributeError):  # only Linux reports it
            found[name] += process.memory_full_info().pss / 2**20
    return dict(found)


def total_s() -> float | None:
    """Return the processor time of this process and of all that have ended under it; None on Windows."""
    return None if sys.platform == "win32" else sum(os.times()[:4])


def _processes() -> Iterator[tuple[psutil.Process, str]]:
    """Yield this process and its descendants, with their names."""
    this = psutil.Process()
    yield this, WINDOW
    for process in this.children(recursive=True):
        with suppress(psutil.Error):
            command = " ".join(process.cmdline())
            yield process, next((name for part, name in _PROCESSES.items() if part in command), "other")
