"""Log of what the light of a stand-in did, so that a test sees a flash that is over when it looks."""

from __future__ import annotations

import time
from itertools import pairwise
from typing import NamedTuple


class LightChange(NamedTuple):
    """State of a light from a moment on."""

    time_s: float  # of `time.monotonic`
    is_on: bool
    level: float  # current or brightness, in the unit of the device; 0 if it is off


class LightLog:
    """The changes of a light, in order, beginning with the first state that was noted."""

    def __init__(self) -> None:
        self.changes: list[LightChange] = []

    def note(self, *, is_on: bool, level: float, time_s: float | None = None) -> None:
        """Note the state after a command, by default one of this moment."""
        if not self.changes or self.changes[-1][1:] != (is_on, level):
            self.changes.append(LightChange(time.monotonic() if time_s is None else time_s, is_on, level))

    @property
    def is_lit(self) -> bool:
        """True if it shone at the end."""
        return bool(self.changes) and self.changes[-1].is_on

    @property
    def lightings(self) -> int:
        """Number of times it went on."""
        return sum(after.is_on and not before.is_on for before, after in pairwise(self.changes))

    @property
    def lit_levels(self) -> list[float]:
        """The levels with which it shone, in order."""
        return [change.level for change in self.changes if change.is_on]

    @property
    def off_s(self) -> float:
        """When it went off last."""
        return max(after.time_s for before, after in pairwise(self.changes) if before.is_on and not after.is_on)
