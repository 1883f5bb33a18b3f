"""Display scales that follow the data in coarse steps, so that pictures stay comparable from frame to frame."""

import math

import numpy as np

from drivers.interface import Frame

MAGNIFICATIONS = (1.0, 2.0, 5.0)
RANGES = (1.0, 1.5, 2.0, 3.0, 5.0, 7.0)  # finer: a map always uses most of its colours
_FILL = 0.8  # the scale falls only if the next lower step is filled no further than this

_LEVELS_INTERVAL_S = 0.5
_LEVELS_PERCENT = (1.0, 99.8)
_LEVELS_SLACK = 0.1  # of their span: smaller changes leave the levels alone


class AdaptiveScale:
    """A limit that rises at once when exceeded and falls only when clearly too large."""

    def __init__(self, steps: tuple[float, ...]) -> None:
        """Take values from `steps`, which cover one decade, times any power of ten."""
        self._steps = steps
        self.is_set = False
        self.value = 1.0

    def follow(self, needed: float) -> float:
        """Adapt to `needed` and return the limit; ignore values that are not positive and finite."""
        if math.isfinite(needed) and needed > 0:
            if needed > self.value or not self.is_set:
                self.is_set = True
                self.value = self._step_above(needed)
            else:
                self.value = min(self.value, self._step_above(needed / _FILL))
        return self.value

    def use(self, value: float) -> None:
        """Take a limit as it is, until another is needed."""
        self.is_set, self.value = True, value

    def _step_above(self, value: float) -> float:
        """Return the smallest step that is at least `value`."""
        decade = 10.0 ** math.floor(math.log10(value))
        return next(step * decade for step in (*self._steps, 10.0) if step * decade >= value * (1 - 1e-9))


class ContrastLevels:
    """Black and white level of the camera image; changes are rare and coarse, so that it does not flicker."""

    def __init__(self) -> None:
        self.levels = (0.0, 1.0)
        self._time_s = -math.inf

    def restart(self) -> None:
        """Adapt to the next frame at once."""
        self._time_s = -math.inf

    def use(self, low: float, high: float) -> None:
        """Take these levels, in counts, until they follow a frame."""
        self.levels = (low, max(high, low + 1))

    def follow(self, frame: Frame, full_scale: int, *, is_automatic: bool) -> None:
        """Adapt to a frame: to 1 % and 99.8 % of its pixels if automatic, else to 0 and the full scale."""
        if frame.host_time_s < self._time_s + _LEVELS_INTERVAL_S:
            return
        self._time_s = frame.host_time_s
        low, high = 0.0, float(full_scale)
        if is_automatic or not full_scale:
            low, high = (float(level) for level in np.percentile(frame.pixels[::4, ::4], _LEVELS_PERCENT))
        change = max(abs(low - self.levels[0]), abs(high - self.levels[1]))
        if change > _LEVELS_SLACK * (self.levels[1] - self.levels[0]):
            self.levels = (low, max(high, low + 1))
