"""The layers of the sample and the estimator's bias, found in live frames by a child process.

A search for layers takes a second or more, a round of refinement some tenths of one. Sample and bias belong together
and are replaced together. A correction that made the misfit of the modelled displacements worse is not used nearby.
"""

import math
import pickle
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from app.measurement.estimator import Estimator
from app.measurement.measurement import Assumptions
from reconstruction.displacement import Displacement
from reconstruction.errors import ReconstructionError
from reconstruction.layers.layered_wavefront import FREE, AssumedSample
from reconstruction.refinement import Bias, Refinement
from reconstruction.runtime.background import BackgroundProcess
from reconstruction.runtime.threads import one_blas_thread

_HARM = 1.2  # rise of the misfit by a harmful correction; noise stays below
_HARM_PX = 0.003  # added, for a misfit of nearly 0
_REST, _LONG_REST = 1, 9  # after a search, over its time; the latter if it has found the same again
_LONGEST_REST_S = 5.0
_SAME_SIGMAS = 3.0


class Solved(NamedTuple):
    """A live frame."""

    measured: Displacement  # before the bias
    time_s: float
    assumed: Assumptions


class Found(NamedTuple):
    """Sample and bias for the frames that follow."""

    sample: AssumedSample | None  # None: not found yet
    bias: Bias | None = None  # of a wavefront of that sample
    time_s: float = math.nan  # of the frame that gave the bias
    helps: bool = True  # whether corrections near it help
    problem: str = ""  # why nothing new was found
    idle_s: float = 0.0  # time until there is something to find, unless the wavefront changes


class Finder:
    """Finds sample and bias for the frames of one estimator, one frame after the other."""

    def __init__(self, estimator: Estimator) -> None:
        self._estimator, self._reconstructor = estimator, estimator.reconstructor
        searches = self._reconstructor.may_be_layered
        self._refinement: Refinement | None = None
        self._found = Found(None if searches else FREE)
        self._search_due_s = -math.inf if searches else math.inf
        self._uncorrected_px = math.inf  # misfit of the last uncorrected wavefront

    def prepare(self) -> None:
        """Prepare the refinement; `ReconstructionError` if it is impossible and there are no layers to find."""
        estimator = self._estimator
        if estimator.calibration.bench.reconstruction.refine:
            try:
                self._refinement = estimator.refinement
            except ReconstructionError as error:  # the reference does not allow one
                if not self._reconstructor.may_be_layered:
                    raise
                self._found = self._found._replace(problem=str(error))

    def find(self, newest: Solved) -> Found:
        """Search for layers in a frame if that is due, and find the bias; both as before where that is impossible."""
        try:
            self._found = self._find(newest, self._found)
        except ReconstructionError as error:  # the next wavefront may succeed
            self._found = self._found._replace(problem=str(error), idle_s=0.0)
        return self._found

    def _find(self, newest: Solved, before: Found) -> Found:
        sample, correction = before.sample, newest.assumed.refinement
        begin_s = time.monotonic()
        if begin_s >= self._search_due_s:
            rest = _REST
            try:
                sample = self._reconstructor.find_sample(newest.measured)
                if before.sample is not None and _are_alike(sample, before.sample):
                    rest = _LONG_REST
            finally:
                end_s = time.monotonic()
                self._search_due_s = end_s + min(rest * (end_s - begin_s), _LONGEST_REST_S)
        elif correction.stage == "worse":  # until the wavefront changes
            return before._replace(idle_s=self._idle_s())
        if self._refinement is None:
            return before._replace(sample=sample, idle_s=self._idle_s())
        applied = correction.bias
        if sample is not None and len(sample.ratios) != len((newest.assumed.sample or FREE).ratios):
            applied = None  # of quite another wavefront
        wavefront = self._reconstructor.solve(newest.measured, bias=applied, sample=sample or FREE)
        bias = self._refinement.bias(wavefront)
        misfit_px = bias.misfit_px(newest.measured)
        if applied is None:
            self._uncorrected_px = misfit_px
        return Found(sample, bias, newest.time_s, misfit_px <= _HARM * self._uncorrected_px + _HARM_PX)

    def _idle_s(self) -> float:
        """Time until the next search is due, or the longest rest if there is none."""
        return min(self._search_due_s - time.monotonic(), _LONGEST_REST_S)


class FinderProcess:
    """A finder in a process of its own, with which it shares its interface."""

    def __init__(self, estimator: Estimator) -> None:
        """Start the process; later, frames may change what the estimator remembers while it is pickled."""
        self._estimator = pickle.dumps(estimator, pickle.HIGHEST_PROTOCOL)
        self._process = BackgroundProcess(_work)
        self.process = self._process.process
        self._sample: AssumedSample | None = FREE

    def prepare(self) -> None:
        """See `Finder.prepare`; `EOFError` or `OSError` if the process has ended."""
        self._process.send(self._estimator)
        self._estimator = b""
        if problem := self._process.receive():
            raise ReconstructionError(problem)

    def find(self, newest: Solved) -> Found:
        """See `Finder.find`; `EOFError` or `OSError` if the process has ended."""
        measured = replace(newest.measured, transmission_source=None)  # costly, not used
        self._process.send(newest._replace(measured=measured))
        found: Found = self._process.receive()
        if found.sample is None or self._sample is None or not _are_the_same(found.sample, self._sample):
            self._sample = found.sample
        return found._replace(sample=self._sample)  # a copy would count as another sample

    def stop(self) -> None:
        """Kill the process; a thread that waits for it is told that it has ended."""
        self._process.kill()

    def close(self) -> None:
        """End the process, when no thread uses it any more."""
        self._process.close()


def _work(messages: Iterator[Any], answer: Callable[[object], None]) -> None:
    """Be the process of a `FinderProcess`."""
    finder = Finder(pickle.loads(next(messages)))  # noqa: S301 - our own parent wrote it
    with one_blas_thread():
        try:
            finder.prepare()
        except ReconstructionError as error:
            answer(str(error))
            return
        answer("")
        for newest in messages:
            answer(finder.find(newest))


def _are_the_same(one: AssumedSample, other: AssumedSample) -> bool:
    return one.ratios == other.ratios and np.array_equal(one.sigma, other.sigma)


def _are_alike(found: AssumedSample, before: AssumedSample) -> bool:
    """True if two searches have found as many layers, at places that differ by no more than their errors."""
    if len(found.ratios) != len(before.ratios):
        return False
    moved = np.abs(np.subtract(found.ratios, before.ratios))
    return bool(np.all(moved <= _SAME_SIGMAS * np.hypot(found.sigma, before.sigma)))
