"""Processor time and memory of this process and of all that descend from it; Linux only, elsewhere nothing is known."""

from __future__ import annotations

import os
import re
import sys
from collections import defaultdict
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path

RENDERING, INSTRUMENT, WINDOW, DETECTOR = "simulated rendering", "instrument", "window", "detector"
_PROC = Path("/proc/")
_PROCESSES = {  # by a part of the command line
    "render_missing": RENDERING,
    "background_estimator": "background estimator",
    "watchdog": "watchdog",
    "\0serve\0": INSTRUMENT,
}
_PARENT, _USER, _SYSTEM = 1, 11, 12  # places in what follows the name in `stat`


def processes() -> dict[int, str]:
    """Return the names of this process and its descendants by their ids; empty if the system does not tell them."""
    if sys.platform != "linux":
        return {}
    parents = {
        int(path.parent.name): int(found[1][_PARENT]) for path in _PROC.glob("[0-9]*/stat") if (found := _read(path))
    }
    family = {os.getpid(): WINDOW}
    while more := {pid for pid, parent in parents.items() if parent in family} - family.keys():
        family |= {pid: _name(pid) for pid in more}
    return family


def processor_times(of: Iterable[int]) -> dict[tuple[int, str], float]:
    """Return the seconds that each thread of the processes has taken so far, by process and name.

    The name "" stands for the whole process, with threads that have ended.
    """
    seconds: defaultdict[tuple[int, str], float] = defaultdict(float)
    ticks_per_s = os.sysconf("SC_CLK_TCK") if sys.platform == "linux" else 1
    for pid in of:
        for path in (_PROC / f"{pid}/stat", *_PROC.glob(f"{pid}/task/*/stat")):
            if (found := _read(path)) is not None:
                name, numbers = found
                thread = "" if path.parent.parent == _PROC else "main" if path.parent.name == str(pid) else name
                seconds[pid, thread] += (int(numbers[_USER]) + int(numbers[_SYSTEM])) / ticks_per_s
    return seconds


def memory_mb(of: Mapping[int, str]) -> dict[str, float]:
    """Return the memory of processes by name, MB of 2**20 bytes, what they share in equal parts (PSS); {}: unknown."""
    found = dict[str, float]()
    for pid, name in of.items():
        with suppress(OSError):  # it has just ended
            shares = re.search(r"^Pss: +(\d+) kB", (_PROC / f"{pid}/smaps_rollup").read_text(), re.MULTILINE)
            if shares is not None:
                found[name] = found.get(name, 0.0) + int(shares[1]) / 1024
    return found


def total_s() -> float | None:
    """Return the processor time of this process and of all that have ended under it; None on Windows."""
    return None if sys.platform == "win32" else sum(os.times()[:4])


def _name(pid: int) -> str:
    with suppress(OSError):
        command = (_PROC / f"{pid}/cmdline").read_bytes().decode(errors="replace")
        return next((name for part, name in _PROCESSES.items() if part in command), "other")
    return "other"


def _read(path: Path) -> tuple[str, list[str]] | None:
    """Return name and what follows it of a `stat`; None if the process or thread has ended."""
    with suppress(OSError):
        before, _, after = path.read_text(errors="replace").rpartition(")")
        return before.partition("(")[2], after.split()
    return None
