"""Times of several things side by side, so that whatever else the computer does slows all of them alike."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from app.progress import Progress

_TURN_S = 0.02  # what is quicker is called again and again for so long, before the next one's turn
_LEAST_CALLS = 3


@dataclass(slots=True)
class Times:
    """How long each call took."""

    seconds: list[float] = field(default_factory=list)

    @property
    def median_s(self) -> float:
        """What a call takes as a rule."""
        return float(np.median(self.seconds))

    @property
    def best_s(self) -> float:
        """What a call takes when nothing else is going on."""
        return min(self.seconds)


def side_by_side(
    contestants: Mapping[str, Callable[[], Any]], budget_s: float, progress: Progress | None = None
) -> dict[str, Times]:
    """Call all contestants in turn until each has had `budget_s` and three calls; the first call of each is not timed.

    That one may compile or load something.
    """
    times = {name: Times() for name in contestants}
    for index, (name, call) in enumerate(contestants.items()):
        if progress is not None:
            progress(name, index / len(contestants) / 2)
        call()
    waiting = dict(contestants)
    while waiting:
        for name, call in list(waiting.items()):
            if progress is not None:
                progress(name, 1 - len(waiting) / len(contestants) / 2)
            turn_s = 0.0
            while turn_s < _TURN_S:
                start_s = time.perf_counter()
                call()
                times[name].seconds.append(time.perf_counter() - start_s)
                turn_s += times[name].seconds[-1]
            if sum(times[name].seconds) >= budget_s and len(times[name].seconds) >= _LEAST_CALLS:
                del waiting[name]
    return times
