"""Clocks of the simulated devices: the machine's own, and one that a test moves on."""

import time


class Clock:
    """The machine's time, `time.perf_counter()`."""

    def now(self) -> float:
        """Seconds since a fixed moment."""
        return time.perf_counter()

    def sleep(self, duration_s: float) -> None:
        """Return after that time."""
        time.sleep(duration_s)


class ManualClock(Clock):
    """Stands still until `sleep`, then jumps, so that a test needs no real time."""

    def __init__(self) -> None:
        self._now = 0.0

    def now(self) -> float:
        """Seconds since the clock was made."""
        return self._now

    def sleep(self, duration_s: float) -> None:
        """Let that time pass at once."""
        self._now += duration_s
