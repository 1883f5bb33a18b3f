"""Reconstruction of live frames, with what a low-priority thread finds: the sample's layers and the estimator's bias.

A search for layers takes a second or more. Searches follow each other for as long as frames come, at longer intervals
if they find the same. Between them the thread refines: a round takes some tenths of a second. It rests in between,
because it shares Python's lock with the frames. Sample and bias belong together and are replaced together.

If the wavefront has changed much since the bias was found, the old bias would do harm: frames stay uncorrected until
the next one is found. A correction that made the misfit of the modelled displacements worse is not used again nearby.
"""

import math
import os
import sys
import threading
import time
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from app.measurement.estimator import Estimator
from app.measurement.measurement import Assumptions, RefinementStage, RefinementState
from reconstruction.displacement import Displacement
from reconstruction.errors import ReconstructionError
from reconstruction.layers.layered_wavefront import FREE, AssumedSample
from reconstruction.refinement import Bias, Refinement, mean_rms
from reconstruction.wavefront import Wavefront

_MOVED_FRACTION = 0.5  # of the RMS of the bias's wavefront; after a larger change the bias is useless
_MOVED_RAD = 0.1  # limit for a nearly flat wavefront
_HARM = 1.2  # rise of the misfit by a harmful correction; noise stays below
_HARM_PX = 0.003  # added, for a misfit of nearly 0
_REST, _LONG_REST = 1, 9  # after a search, over its time; the latter if it has found the same again
_LONGEST_REST_S = 5.0
_SAME_SIGMAS = 3.0
_NICENESS = 10
_WAIT_S = 0.2


class _Solved(NamedTuple):
    wavefront: Wavefront
    measured: Displacement  # before the bias
    time_s: float
    assumed: Assumptions


class _Found(NamedTuple):
    sample: AssumedSample | None
    bias: Bias | None = None  # of a wavefront of that sample
    time_s: float = math.nan  # of the frame that gave the bias
    helps: bool = True  # whether corrections near it help


class _Closed(Exception):
    """Ends a search or a rendering."""


class LiveSolver:
    """Solves for one estimator's frames; its thread ends soon after `close`."""

    def __init__(self, estimator: Estimator) -> None:
        """Start the thread if there is anything to find.

        With refinement, building its model blocks all threads for some tenths of a second.
        """
        self._estimator, self._reconstructor = estimator, estimator.reconstructor
        self._searches = self._reconstructor.may_be_layered
        self._refines = estimator.calibration.bench.reconstruction.refine
        self._newest: _Solved | None = None  # one slot each way, written by one thread
        self._found = _Found(None if self._searches else FREE)
        self._problem = ""
        self._search_due_s = -math.inf if self._searches else math.inf
        self._uncorrected_px = math.inf  # misfit of the last uncorrected wavefront
        self._something_new, self._closing = threading.Event(), threading.Event()
        self.prepares = self._searches or self._refines
        if self._refines:
            try:
                _ = estimator.model
            except ReconstructionError as error:  # the reference does not allow one
                self._problem = str(error)
        has_model = self._refines and not self._problem
        if self._searches or has_model:
            threading.Thread(target=self._work, args=(has_model,), name="live-solver", daemon=True).start()

    def close(self) -> None:
        """Stop at once, but not amid a registration or a fit."""
        self._closing.set()

    def solve(self, displacement: Displacement, time_s: float) -> tuple[Wavefront, Assumptions]:
        """Reconstruct a frame exposed at `time_s`, with the newest sample, and the newest bias if it applies."""
        found = self._found  # read once: the thread may replace it
        sample = found.sample or FREE
        if found.bias is None:
            wavefront = self._reconstructor.solve(displacement, sample=sample)
            state = self._uncorrected()
        else:
            bias = found.bias
            wavefront = self._reconstructor.solve(displacement, bias=bias.displacement, sample=sample)
            moved_rad = mean_rms(wavefront.views - bias.views)
            stage: RefinementStage = "applied" if found.helps else "worse"
            if moved_rad > max(_MOVED_RAD, _MOVED_FRACTION * mean_rms(bias.views)):
                stage = "moved"
            if stage != "applied":
                wavefront = self._reconstructor.solve(displacement, sample=sample)
            applied = bias.displacement if stage == "applied" else None
            state = RefinementState(stage, time_s - found.time_s, moved_rad, bias=applied)
        assumed = Assumptions(found.sample, state)
        self._newest = _Solved(wavefront, displacement, time_s, assumed)
        self._something_new.set()
        return wavefront, assumed

    def as_before(self, time_s: float) -> Assumptions:
        """Return the assumptions of the previous frame, for a skipped frame exposed at `time_s`."""
        before = self._newest
        if before is None:
            return Assumptions(self._found.sample, self._uncorrected())
        sample, refinement = before.assumed
        return Assumptions(sample, replace(refinement, age_s=refinement.age_s + time_s - before.time_s))

    def _uncorrected(self) -> RefinementState:
        """State of a frame before the first bias."""
        if not self._refines:
            return RefinementState()
        return RefinementState("failed" if self._problem else "preparing", problem=self._problem)

    def _work(self, has_model: bool) -> None:
        """Search and refine with the newest frame repeatedly."""
        if sys.platform == "linux":  # threads have their own priority only here
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICENESS)
        try:
            refinement = self._estimator.refinement if has_model else None
            while not self._closing.is_set():
                if self._something_new.wait(_WAIT_S) and self._newest is not None:
                    self._something_new.clear()
                    begin_s = time.monotonic()
                    try:
                        self._found = self._find(self._newest, self._found, refinement)
                    except ReconstructionError as error:  # the next wavefront may succeed
                        self._problem = str(error)
                    self._rest(time.monotonic() - begin_s)
        except _Closed:
            pass
        except Exception as error:
            self._found, self._problem = _Found(self._found.sample), str(error)
            # At interpreter exit the worker pool ends before this thread: not a fault.
            is_over = isinstance(error, RuntimeError) and self._closing.is_set()
            if not (is_over or isinstance(error, ReconstructionError)):
                raise

    def _rest(self, seconds: float) -> None:
        """Wait, unless frames lack a correction."""
        end_s = time.monotonic() + seconds
        while (left_s := end_s - time.monotonic()) > 0 and not self._closing.is_set():
            if self._newest is not None and self._newest.assumed.refinement.stage not in {"off", "applied"}:
                return
            self._closing.wait(min(left_s, _WAIT_S))

    def _find(self, newest: _Solved, before: _Found, refinement: Refinement | None) -> _Found:
        """Search for layers in the newest frame if that is due, and find the bias."""
        sample, wavefront, correction = before.sample, newest.wavefront, newest.assumed.refinement
        begin_s = time.monotonic()
        if begin_s >= self._search_due_s:
            rest = _REST
            try:
                sample = self._reconstructor.find_sample(newest.measured, self._check_open)
                if _are_alike(sample, before.sample):
                    rest = _LONG_REST
            finally:
                end_s = time.monotonic()
                self._search_due_s = end_s + min(rest * (end_s - begin_s), _LONGEST_REST_S)
        elif correction.stage == "worse":  # until the wavefront changes
            return before
        applied = correction.bias
        if sample is not None and wavefront.sample is not sample:
            if len(sample.ratios) != len(wavefront.sample.ratios):
                applied = None  # of quite another wavefront
            wavefront = self._reconstructor.solve(newest.measured, bias=applied, sample=sample)
            wavefront.sigma()  # what depends on the layers is prepared here, not when it is first shown
        if refinement is None:
            return _Found(sample)
        bias = refinement.bias(wavefront, self._check_open)
        misfit_px = bias.misfit_px(newest.measured)
        if applied is None:
            self._uncorrected_px = misfit_px
        return _Found(sample, bias, newest.time_s, misfit_px <= _HARM * self._uncorrected_px + _HARM_PX)

    def _check_open(self) -> None:
        if self._closing.is_set():
            raise _Closed


def _are_alike(found: AssumedSample, before: AssumedSample | None) -> bool:
    """True if two searches have found as many layers, at places that differ by no more than their errors."""
    if before is None or len(found.ratios) != len(before.ratios):
        return False
    moved = np.abs(np.subtract(found.ratios, before.ratios))
    return bool(np.all(moved <= _SAME_SIGMAS * np.hypot(found.sigma, before.sigma)))
