"""Scales that follow what is shown in round steps, so that the eye can trust them from frame to frame."""

from __future__ import annotations

import math

MAGNIFICATIONS = (1.0, 2.0, 5.0)
RANGES = (1.0, 1.5, 2.0, 3.0, 5.0, 7.0)  # finer, so that a map always uses most of its colours
_SLACK = 0.8  # a scale falls only when the lower step would be filled no further than this


def step_above(value: float, steps: tuple[float, ...]) -> float:
    """Return the smallest of the `steps` within a decade, times any power of ten, that is at least `value` > 0."""
    decade = 10.0 ** math.floor(math.log10(value))
    return next(step * decade for step in (*steps, 10.0) if step * decade >= value * (1 - 1e-9))


class SteppedScale:
    """A scale that rises at once when it is exceeded, and falls only when it is clearly too large."""

    def __init__(self, steps: tuple[float, ...]) -> None:
        """Take values from `steps` within a decade, times any power of ten."""
        self._steps = steps
        self.is_set = False  # whether it has ever been told anything
        self.value = 1.0

    def follow(self, needed: float) -> float:
        """Make room for `needed`; what is no positive number changes nothing."""
        if not (math.isfinite(needed) and needed > 0):
            return self.value
        if needed > self.value or not self.is_set:
            self.is_set = True
            self.value = step_above(needed, self._steps)
        else:
            self.value = min(self.value, step_above(needed / _SLACK, self._steps))
        return self.value
