"""Processor time and memory of this process and of all that descend from it; Linux only, elsewhere nothing is known."""

from __future__ import annotations

import os
import re
import sys
from collections import defaultdict
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

RENDERING, INSTRUMENT, WINDOW, DETECTOR = "simulated rendering", "instrument", "window", "detector"
Times = dict[str, dict[str, float]]  # seconds of each thread by process; the thread "" stands for the whole process
_PROC = Path("/proc/")
_PROCESSES = {  # by a part of the command line
    "render_missing": RENDERING,
    "background_estimator": "background estimator",
    "watchdog": "watchdog",
    "\0serve\0": INSTRUMENT,
}
_TICKS_PER_S = 100  # of what Linux tells programs
_USER, _SYSTEM = 11, 12  # places in what follows the name in `stat`


def processor_times(since: Times | None = None) -> Times:
    """Return the processor time of each process and thread so far, or since an earlier answer."""
    seconds: defaultdict[str, dict[str, float]] = defaultdict(dict)
    for folder, process in _processes(_PROC / str(os.getpid()), WINDOW):
        for path in (folder / "stat", *folder.glob("task/*/stat")):
            with suppress(OSError):  # it has just ended
                before, _, after = path.read_text(errors="replace").rpartition(")")
                name = "main" if path.parent.name == folder.name else before.partition("(")[2]
                thread, ticks = "" if path.parent == folder else name, after.split()
                taken_s = (int(ticks[_USER]) + int(ticks[_SYSTEM])) / _TICKS_PER_S
                seconds[process][thread] = seconds[process].get(thread, 0.0) + taken_s
    earlier = since or {}
    return {
        process: {thread: max(end - earlier.get(process, {}).get(thread, 0.0), 0.0) for thread, end in threads.items()}
        for process, threads in seconds.items()
    }


def memory_mb() -> dict[str, float]:
    """Return the memory by process, MB of 2**20 bytes, what they share in equal parts (PSS); {}: unknown."""
    found: defaultdict[str, float] = defaultdict(float)
    for folder, name in _processes(_PROC / str(os.getpid()), WINDOW):
        with suppress(OSError):
            for kilobytes in re.findall(r"^Pss: +(\d+) kB", (folder / "smaps_rollup").read_text(), re.MULTILINE):
                found[name] += int(kilobytes) / 1024
    return dict(found)


def total_s() -> float | None:
    """Return the processor time of this process and of all that have ended under it; None on Windows."""
    return None if sys.platform == "win32" else sum(os.times()[:4])


def _processes(folder: Path, name: str) -> Iterator[tuple[Path, str]]:
    """Yield a process and its descendants, with their names."""
    yield folder, name
    for path in folder.glob("task/*/children"):
        with suppress(OSError):
            for child in (_PROC / number for number in path.read_text().split()):
                command = (child / "cmdline").read_bytes().decode(errors="replace")
                known = (name for part, name in _PROCESSES.items() if part in command)
                yield from _processes(child, next(known, "other"))
