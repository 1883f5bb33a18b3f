"""Stage times and result latency of the live path, always measured.

Each stage keeps its last few thousand times in a ring buffer written by the thread that runs the stage: 1 us per
entry. Readers may miss the newest entry but never see a wrong one.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

TimedStage = Literal[
    "wait",  # for the camera's next frame
    "copy",  # from a frame's arrival until it can be used
    "register",  # displacements from the pixels
    "reconstruct",  # wavefront from the displacements
    "publish",  # to the recorder and other consumers
    "command",  # between two frames
    "record",  # a frame written to disk, in another thread
    "draw",  # window redraw, painting included
    "to_result",  # from the end of a frame's exposure to its result
    "to_screen",  # from the end of a frame's exposure to its painting
]
STAGES: tuple[TimedStage, ...] = get_args(TimedStage)
KEPT = 4096  # times per stage; a minute at the highest frame rate


@dataclass(frozen=True, slots=True)
class StageTimes:
    """Statistics of one stage."""

    count: int = 0  # since the start
    p50_s: float = math.nan  # of the kept times
    p99_s: float = math.nan  # of the kept times
    max_s: float = math.nan  # since the start, or that of the last recording


class _Ring:
    """Ring buffer of one stage's times, written by one thread."""

    def __init__(self, kept: int) -> None:
        self._times_s = np.zeros(kept)
        self._count, self._max_s = 0, math.nan

    def note(self, seconds: float) -> None:
        self._times_s[self._count % len(self._times_s)] = seconds
        self._count += 1
        if not seconds <= self._max_s:
            self._max_s = seconds

    def forget_longest(self) -> None:
        self._max_s = math.nan

    def summary(self) -> StageTimes:
        count = self._count
        if not count:
            return StageTimes()
        p50_s, p99_s = np.percentile(self._times_s[:count], (50, 99))
        return StageTimes(count, float(p50_s), float(p99_s), self._max_s)


class Timings:
    """Times of all stages; the last `kept` of each are stored."""

    def __init__(self, kept: int = KEPT) -> None:
        self._rings = {stage: _Ring(kept) for stage in STAGES}

    def note(self, stage: TimedStage, seconds: float) -> None:
        """Add one time of a stage that has just ended."""
        self._rings[stage].note(seconds)

    def forget_longest(self) -> None:
        """Begin anew with the longest time of each stage."""
        for ring in self._rings.values():
            ring.forget_longest()

    @contextmanager
    def of(self, stage: TimedStage) -> Iterator[None]:
        """Time the body of a `with`, unless it raises."""
        start_s = time.perf_counter()
        yield
        self.note(stage, time.perf_counter() - start_s)

    def summary(self) -> dict[TimedStage, StageTimes]:
        """Statistics of every stage."""
        return {stage: ring.summary() for stage, ring in self._rings.items()}
