"""Processor time and memory of this process and of all that descend from it."""

from __future__ import annotations

import os
import sys
from collections import defaultdict
from collections.abc import Callable
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
    return _by_process(lambda process: sum(process.cpu_times()[:2]))


def memory_mb() -> dict[str, float]:
    """Return the memory by process, MB of 2**20 bytes, what they share in equal parts (PSS); {}: unknown."""
    return _by_process(lambda process: process.memory_full_info().pss / 2**20)


def total_s() -> float | None:
    """Return the processor time of this process and of all that have ended under it; None on Windows."""
    return None if sys.platform == "win32" else sum(os.times()[:4])


def _by_process(measure: Callable[[psutil.Process], float]) -> dict[str, float]:
    """Apply a measurement to this process and its descendants; processes of one name are summed."""
    this, found = psutil.Process(), defaultdict[str, float](float)
    for process in (this, *this.children(recursive=True)):
        with suppress(psutil.Error, AttributeError):  # it has just ended; only Linux reports the memory
            command = " ".join(process.cmdline())
            name = next((name for part, name in _PROCESSES.items() if part in command), "other")
            amount = measure(process)  # an unknown one leaves no entry
            found[WINDOW if process == this else name] += amount
    return dict(found)
