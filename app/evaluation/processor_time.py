"""Processor time and memory of this process and of all that descend from it."""

from __future__ import annotations

import os
import sys
from collections import defaultdict
from collections.abc import Iterator
from contextlib import suppress

import psutil

RENDERING, INSTRUMENT, WINDOW = "simulated rendering", "instrument", "window"
_PROCESSES = {  # by a part of the command line
    "render_missing": RENDERING,
    "background_estimator": "background estimator",
    "watchdog": "watchdog",
    " serve ": INSTRUMENT,
}


def processor_times() -> dict[str, float]:
    """Return the processor time by process so far, s."""
    taken_s: defaultdict[str, float] = defaultdict(float)
    for process, name in _processes():
        with suppress(psutil.Error):  # it has just ended
            taken_s[name] += sum(process.cpu_times()[:2])
    return dict(taken_s)


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
