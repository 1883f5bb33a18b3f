"""Stage times and result latency of the live path, always measured, with the cause of the longest.

Each stage keeps its last few thousand times in a ring buffer written by the thread that runs the stage: 1 us per
entry. Readers may miss the newest entry but never see a wrong one.
"""

from __future__ import annotations

import gc
import math
import time
from collections import Counter, deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
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
_LONG_S = 0.005  # what takes longer may be the cause of a pause
_CAUSES = 2  # named, the longest first
_SPANS: tuple[TimedStage, ...] = ("wait", "to_result", "to_screen")  # waiting, or the sum of other stages: no causes


@dataclass(frozen=True, slots=True)
class StageTimes:
    """Statistics of one stage."""

    count: int = 0  # since the start
    p50_s: float = math.nan  # of the kept times
    p99_s: float = math.nan  # of the kept times
    max_s: float = math.nan  # since the start, or that of the last recording
    cause: str = ""  # what else ran in this process during the longest; empty if nothing that is known


_long_work: deque[tuple[float, float, str]] = deque(maxlen=256)  # begin, end and name; threads share Python's lock


def _note_work(begin_s: float, name: str) -> None:
    """Remember work that ends now, if it was long."""
    if (end_s := time.perf_counter()) > begin_s + _LONG_S:
        _long_work.append((begin_s, end_s, name))


def _cause(begin_s: float, stage: TimedStage) -> str:
    """Name what has run longest since a time besides the stage itself."""
    overlaps = Counter[str]()
    for other_s, until_s, name in tuple(_long_work):
        overlaps[name] += round(1e3 * max(until_s - max(other_s, begin_s), 0.0))
    del overlaps[stage]
    return ", ".join(f"{name} {ms} ms" for name, ms in overlaps.most_common(_CAUSES) if ms)


@cache
def _watch_garbage_collection() -> None:
    """Note long garbage collections from now on."""
    begun_s: list[float] = []

    def note(phase: str, _: dict[str, int]) -> None:
        if phase == "start":
            begun_s.append(time.perf_counter())
        elif begun_s:
            _note_work(begun_s.pop(), "garbage collection")

    gc.callbacks.append(note)


class _Ring:
    """Ring buffer of one stage's times, written by one thread."""

    def __init__(self, kept: int) -> None:
        self._times_s = np.zeros(kept)
        self._count, self._max_s, self._cause = 0, math.nan, ""

    def note(self, seconds: float, stage: TimedStage) -> None:
        self._times_s[self._count % len(self._times_s)] = seconds
        self._count += 1
        if not seconds <= self._max_s:
            self._max_s, self._cause = seconds, _cause(time.perf_counter() - seconds, stage)

    def forget_longest(self) -> None:
        self._max_s, self._cause = math.nan, ""

    def summary(self) -> StageTimes:
        count = self._count
        if not count:
            return StageTimes()
        p50_s, p99_s = np.percentile(self._times_s[:count], (50, 99))
        return StageTimes(count, float(p50_s), float(p99_s), self._max_s, self._cause)


class Timings:
    """Times of all stages; the last `kept` of each are stored."""

    def __init__(self, kept: int = KEPT) -> None:
        self._rings = {stage: _Ring(kept) for stage in STAGES}
        _watch_garbage_collection()

    def note(self, stage: TimedStage, seconds: float) -> None:
        """Add one time of a stage that has just ended."""
        if stage not in _SPANS:
            _note_work(time.perf_counter() - seconds, stage)
        self._rings[stage].note(seconds, stage)

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
