"""Playback of the rendered states of a drifting sample."""

import bisect


class Playback:
    """Shows state 0, 1, 2 ... to the last rendered one and back, `duration_s` each; `states` may grow meanwhile."""

    _REMEMBERED = 2000

    def __init__(self, *, states: int, duration_s: float, start_s: float) -> None:
        self.states = states
        self._duration_s = duration_s
        self._step = 1
        self._begins = [start_s]
        self._shown = [0]

    def state_at(self, time_s: float) -> int:
        """State shown at `time_s`, which may lie a little in the past."""
        behind = (time_s - self._begins[-1]) / self._duration_s
        if behind > self._REMEMBERED:  # after a long time without requests the film goes on where it was
            self._begins.append(time_s - self._duration_s / 2)
            self._shown.append(self._shown[-1])
        while self._begins[-1] + self._duration_s <= time_s:
            self._begins.append(self._begins[-1] + self._duration_s)
            self._shown.append(self._next())
        del self._begins[: -self._REMEMBERED], self._shown[: -self._REMEMBERED]
        return self._shown[max(0, bisect.bisect_right(self._begins, time_s) - 1)]

    def _next(self) -> int:
        state = self._shown[-1]
        if not 0 <= state + self._step < self.states:
            self._step = -self._step
        return min(max(state + self._step, 0), self.states - 1)
