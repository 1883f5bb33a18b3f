"""Time, as the simulated devices see it: the machine's own, or one that a test turns by hand."""

from __future__ import annotations

import time
from typing import Protocol


class Clock(Protocol):
    """What tells the time and lets it pass."""

    def now(self) -> float:
        """Seconds since some moment."""

    def sleep(self, duration_s: float) -> None:
        """Return after that time."""


class SystemClock:
    """The machine's own time, that of `time.perf_counter()`."""

    def now(self) -> float:
        """Seconds since some moment."""
        return time.perf_counter()

    def sleep(self, duration_s: float) -> None:
        """Return after that time."""
        time.sleep(duration_s)


class ManualClock:
    """Stands still until it is told to sleep, then jumps: a test needs no real time."""

    def __init__(self) -> None:
        self._now = 0.0

    def now(self) -> float:
        """Seconds since the clock was made."""
        return self._now

    def sleep(self, duration_s: float) -> None:
        """Let that time pass at once."""
        self._now += duration_s
