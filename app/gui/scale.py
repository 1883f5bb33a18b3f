"""Scales that follow what is shown in steps of 1, 2, 5, 10 ..., so that the eye can trust them from frame to frame."""

from __future__ import annotations

import math

_STEPS = (1.0, 2.0, 5.0, 10.0)
_SLACK = 0.8  # a scale falls only when the lower step would be filled no further than this


def step_above(value: float) -> float:
    """Return the smallest of ... 0.5, 1, 2, 5, 10 ... that is at least `value` > 0."""
    decade = 10.0 ** math.floor(math.log10(value))
    return next(step * decade for step in _STEPS if step * decade >= value * (1 - 1e-9))


class SteppedScale:
    """A scale that rises at once when it is exceeded, and falls only when it is clearly too large."""

    def __init__(self, value: float = 1.0) -> None:
        self.value = value

    def follow(self, needed: float) -> float:
        """Make room for `needed`; what is no positive number changes nothing."""
        if not (math.isfinite(needed) and needed > 0):
            return self.value
        if needed > self.value:
            self.value = step_above(needed)
        else:
            self.value = min(self.value, step_above(needed / _SLACK))
        return self.value
