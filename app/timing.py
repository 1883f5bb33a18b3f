"""How long each stage of the live path takes, and how old its results are: always measured, at negligible cost.

A stage's last few thousand times lie in a ring of fixed size, which only the thread that runs the stage writes: an
entry costs a microsecond and no memory. Whoever looks may see a time more or less, never a wrong one.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from reconstruction.runtime.process_setting import ProcessSetting

Stage = Literal["wait", "copy", "register", "reconstruct", "publish", "record", "draw", "to_result", "to_screen"]
STAGES: tuple[Stage, ...] = get_args(Stage)
MEANINGS: dict[Stage, str] = {
    "wait": "for the camera's next frame",
    "copy": "from the frame's arrival here until it can be used",
    "register": "how each subimage lies, from the pixels",
    "reconstruct": "the wavefront, from the displacements",
    "publish": "to whoever takes every result",
    "record": "a frame onto the disk, beside the rest",
    "draw": "in the window, painting included",
    "to_result": "age of a frame, from the end of its exposure, when its result is there",
    "to_screen": "the same when it has been painted",
}
_KEPT = 4096  # times of a stage; a minute of the fastest camera


@dataclass(frozen=True, slots=True)
class Summary:
    """What there is to say of one stage."""

    count: int = 0  # since the beginning
    p50_s: float = math.nan  # of those that are remembered
    p99_s: float = math.nan  # likewise
    max_s: float = math.nan  # since the beginning


class _Ring:
    """The times of one stage, written by one thread."""

    def __init__(self, kept: int) -> None:
        self._times_s = np.zeros(kept)
        self._count, self._max_s = 0, -math.inf

    def note(self, seconds: float) -> None:
        self._times_s[self._count % len(self._times_s)] = seconds
        self._count += 1
        self._max_s = max(self._max_s, seconds)

    def summary(self) -> Summary:
        count = self._count
        if not count:
            return Summary()
        p50_s, p99_s = np.percentile(self._times_s[:count], (50, 99))
        return Summary(count, float(p50_s), float(p99_s), self._max_s)


_TURN_S = 0.0005


def short_turns() -> AbstractContextManager[None]:
    """Let Python's threads take turns every half millisecond instead of every five, while a `with` lasts.

    A thread asks for its turn after each call of the operating system; with a busy window beside it, writing a frame,
    ten such calls, would take up to 50 ms instead of 5. Several acquisitions may ask for it, and end in any order.
    """
    return _short_turns.wanted()


def _shorten_turns() -> Callable[[], object]:
    before_s = sys.getswitchinterval()
    sys.setswitchinterval(_TURN_S)
    return lambda: sys.setswitchinterval(before_s)


_short_turns = ProcessSetting(_shorten_turns)


class Timings:
    """The times of all stages since the beginning, of which the last `kept` of each are remembered."""

    def __init__(self, kept: int = _KEPT) -> None:
        self._rings = {stage: _Ring(kept) for stage in STAGES}
        self._spans: tuple[Timings, ...] = ()

    def begin_span(self, kept: int) -> Timings:
        """Return times that begin now: whatever is noted here is noted there, too, until `end_span`."""
        span = Timings(kept)
        self._spans = (*self._spans, span)  # replaced, not changed: other threads go through it
        return span

    def end_span(self, span: Timings) -> None:
        """Note nothing more in a span."""
        self._spans = tuple(each for each in self._spans if each is not span)

    def note(self, stage: Stage, seconds: float) -> None:
        """Take note of how long a stage took."""
        self._rings[stage].note(seconds)
        for span in self._spans:
            span.note(stage, seconds)

    @contextmanager
    def of(self, stage: Stage) -> Iterator[None]:
        """Take note of how long the body of a `with` takes; of one that fails, nothing."""
        start_s = time.perf_counter()
        yield
        self.note(stage, time.perf_counter() - start_s)

    def summary(self) -> dict[Stage, Summary]:
        """Say of each stage how long it takes."""
        return {stage: ring.summary() for stage, ring in self._rings.items()}
