"""Reconstruction of live frames with the layers and the bias that a child process finds.

A search for layers takes a second or more, a round of refinement some tenths of one. Sample and bias belong together
and are replaced together; the frames that follow use what was found last. If the wavefront has changed much since the
bias was found, the old bias would do harm: frames stay uncorrected until the next one is found. So they do nearby if a
correction made the misfit of the modelled displacements worse.
"""

import math
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from app.measurement.estimator import ROUNDS, Estimator
from app.measurement.measurement import Assumptions, RefinementStage, RefinementState
from reconstruction.displacement import Displacement
from reconstruction.errors import ReconstructionError
from reconstruction.layers.layered_wavefront import FREE, AssumedSample
from reconstruction.refinement import Bias, Refinement
from reconstruction.runtime.background import NICENESS, BackgroundProcess, Pickled, pickled
from reconstruction.runtime.child_process import Child, Condition, condition_of
from reconstruction.runtime.threads import one_blas_thread
from reconstruction.wavefront import Wavefront, mean_rms

_HARM = 1.2  # rise of the misfit by a harmful correction; noise stays below
_HARM_PX = 0.003  # added, for a misfit of nearly 0
_REST, _LONG_REST = 1, 9  # after a search, over its time; the latter if it has found the same again
_LONGEST_REST_S = 5.0  # if the wavefront has changed since
_LONGEST_STILL_S = 60.0  # if not; each rest is twice as long as the one before
_SAME_SIGMAS, _KEPT_SIGMAS = 3.0, 1.0  # within the latter the sample found before is kept


class Solved(NamedTuple):
    """A live frame."""

    measured: Displacement  # before the bias
    time_s: float
    assumed: Assumptions
    is_still: bool = False  # the wavefront is that of a frame that was searched before


class Found(NamedTuple):
    """Sample and bias for the frames that follow."""

    sample: AssumedSample | None  # None: not found yet
    bias: Bias | None = None  # of a wavefront of that sample
    time_s: float = math.nan  # of the frame that gave the bias
    is_helpful: bool = True  # corrections near it do no harm
    problem: str = ""  # why nothing new was found
    rest_s: float = 0.0  # time until there may be something to find
    idle_s: float = 0.0  # the same, unless the wavefront changes


class BackgroundEstimator:
    """Finds sample and bias for the frames of one estimator, one frame after the other."""

    def __init__(self, estimator: Estimator) -> None:
        self._estimator, self._reconstructor = estimator, estimator.reconstructor
        searches = self._reconstructor.may_be_layered
        self._refinement: Refinement | None = None
        self._found = Found(None if searches else FREE)
        self._due_s = self._still_due_s = -math.inf if searches else math.inf  # next search; the same if all is still
        self._rest_s, self._has_changed = 0.0, True  # last rest; since the last search
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
        """Search for layers in a frame if that is due, and find the bias; keep what cannot be found."""
        try:
            self._found = self._find(newest, self._found)
        except ReconstructionError as error:  # the next wavefront may succeed
            self._found = self._found._replace(problem=str(error), rest_s=0.0, idle_s=0.0)
        return self._found

    def _find(self, newest: Solved, before: Found) -> Found:
        sample, correction = before.sample, newest.assumed.refinement
        self._has_changed |= not newest.is_still
        due_s = self._due_s if self._has_changed else self._still_due_s
        if newest.assumed.is_other or time.monotonic() >= due_s:
            sample = self._search(newest.measured, before.sample)
        elif correction.stage == "worse":  # until the wavefront changes
            return self._resting(before)
        if self._refinement is None or (newest.is_still and sample is before.sample and before.bias is not None):
            return self._resting(before._replace(sample=sample))
        applied = correction.bias
        if sample is not None and len(sample.ratios) != len((newest.assumed.sample or FREE).ratios):
            applied = None  # of quite another wavefront
        wavefront = self._reconstructor.solve(newest.measured, bias=applied, sample=sample or FREE)
        bias = self._refinement.bias(wavefront)
        misfit_px = bias.misfit_px(newest.measured)
        if applied is None:
            self._uncorrected_px = misfit_px
        is_helpful = misfit_px <= _HARM * self._uncorrected_px + _HARM_PX
        return self._resting(Found(sample, bias, newest.time_s, is_helpful))

    def _search(self, measured: Displacement, before: AssumedSample | None) -> AssumedSample:
        """Find the sample, and say when to search again: later and later while it stays the same."""
        begin_s, is_same = time.monotonic(), False
        self._has_changed = False
        try:
            found = self._reconstructor.find_sample(measured)
            is_same = before is not None and _are_alike(found, before, _SAME_SIGMAS)
        finally:
            end_s = time.monotonic()
            rest_s = (_LONG_REST if is_same else _REST) * (end_s - begin_s)
            self._rest_s = min(max(rest_s, 2 * self._rest_s), _LONGEST_STILL_S) if is_same else rest_s
            self._due_s, self._still_due_s = end_s + min(rest_s, _LONGEST_REST_S), end_s + self._rest_s
        # Each other place would be prepared anew, and noise moves it.
        is_kept = before is not None and _are_alike(found, before, _KEPT_SIGMAS) and found.allowed <= before.allowed
        return before if before is not None and is_kept else found

    def _resting(self, found: Found) -> Found:
        """Add for how long there is nothing to find."""
        now_s = time.monotonic()
        due_s = self._due_s if self._has_changed else self._still_due_s
        return found._replace(rest_s=self._due_s - now_s, idle_s=min(due_s - now_s, _LONGEST_STILL_S))


class BackgroundEstimatorProcess:
    """A background estimator in a process of its own, with which it shares its interface."""

    def __init__(self, estimator: Estimator) -> None:
        """Start the process; later, frames may change what the estimator remembers while it is pickled."""
        self._estimator: Pickled | None = pickled(estimator)
        self._process = BackgroundProcess(_work)
        self.process = self._process.process

    def prepare(self) -> None:
        """See `BackgroundEstimator.prepare`; `EOFError` or `OSError` if the process has ended."""
        self._process.send(self._estimator)
        self._estimator = None
        if problem := self._process.receive():
            raise ReconstructionError(problem)

    def find(self, newest: Solved) -> Found:
        """See `BackgroundEstimator.find`; `EOFError` or `OSError` if the process has ended."""
        measured = replace(newest.measured, transmission_source=None)  # costly, not used
        self._process.send(newest._replace(measured=measured))
        found: Found = self._process.receive()
        return found

    def stop(self) -> None:
        """Kill the process; a thread that waits for it gets an error."""
        self._process.kill()

    def close(self) -> None:
        """End the process, when no thread uses it any more."""
        self._process.close()


def _work(messages: Iterator[Any], answer: Callable[[object], None]) -> None:
    """Be the process of a `BackgroundEstimatorProcess`."""
    background_estimator = BackgroundEstimator(next(messages))
    with one_blas_thread():
        try:
            background_estimator.prepare()
        except ReconstructionError as error:
            answer(str(error))
            return
        answer("")
        for newest in messages:
            answer(background_estimator.find(newest))


def _are_alike(found: AssumedSample, before: AssumedSample, sigmas: float) -> bool:
    """True if two searches have found as many layers within some standard errors; their rivals may differ."""
    if (len(found.ratios), len(found.rivals)) != (len(before.ratios), len(before.rivals)):
        return False
    moved = np.abs(np.subtract(found.ratios, before.ratios))
    return bool(np.all(moved <= sigmas * np.hypot(found.sigma, before.sigma)))


_MOVED_FRACTION = 0.5  # of the RMS of the bias's wavefront; after a larger change the bias is useless
_MOVED_RAD = 0.1  # limit for a nearly flat wavefront
_CORRECTION_REST_S = 1.0  # at most, after a search with a correction, which would grow old
_WAIT_S = 0.2
_NOISES, _STILL_RAD = 2.0, 0.01  # changes of the wavefront from frame to frame, and a least one, that count as noise
_ENDED = "the process that finds layers and corrections has ended: take the reference again (R)"
_FROZEN = "the process that finds layers and corrections was stopped: continue it, or take the reference again (R)"


class LiveEstimator:
    """Solves for one estimator's frames; its thread ends soon after `close`."""

    def __init__(self, estimator: Estimator) -> None:
        """Start background estimator and thread if there is anything to find."""
        self._estimator, self._reconstructor = estimator, estimator.reconstructor
        searches = self._reconstructor.may_be_layered
        self._refines = estimator.calibration.bench.reconstruction.refine
        self._newest: Solved | None = None  # one slot each way, written by one thread
        self._wavefronts: tuple[Wavefront, Wavefront] | None = None  # the newest, and the one before
        self._searched: Wavefront | None = None  # since which nothing has changed, or the last one that was searched
        self._found = Found(None if searches else FREE)
        self.absorbs: bool | None = None  # whether the sample does; None: each frame shows it
        self._something_new, self._closing = threading.Event(), threading.Event()
        self._is_refused = False  # by the reference; then the process ends
        self.has_background_estimator = searches or self._refines
        self._background_estimator = BackgroundEstimatorProcess(estimator) if self.has_background_estimator else None
        if self._background_estimator is not None:
            threading.Thread(
                target=self._work, args=(self._background_estimator,), name="live-estimator", daemon=True
            ).start()

    @property
    def process(self) -> Child | None:
        """The process of the background estimator, if it has one."""
        return None if self._background_estimator is None else self._background_estimator.process

    @property
    def problem(self) -> str:
        """Why layers and corrections are no longer looked for; empty if they are, or the reference allows none."""
        problems: dict[Condition, str] = {"alive": "", "frozen": _FROZEN, "gone": "" if self._is_refused else _ENDED}
        return "" if self.process is None else problems[condition_of(self.process)]

    def close(self) -> None:
        """Stop at once."""
        self._closing.set()
        if self._background_estimator is not None:
            self._background_estimator.stop()

    def solve(self, displacement: Displacement, time_s: float) -> tuple[Wavefront, Assumptions]:
        """Reconstruct a frame exposed at `time_s`, with the newest sample, and the newest bias if it applies.

        A frame that contradicts the sample, with the bias and without, is solved for any wavefront.
        """
        found = self._found  # read once: the thread may replace it
        sample = found.sample or FREE
        if found.bias is None:
            wavefront = self._reconstructor.solve(displacement, sample=sample)
            state = self._uncorrected()
        else:
            bias = found.bias
            wavefront = self._reconstructor.solve(displacement, bias=bias.displacement, sample=sample)
            moved_rad = mean_rms(wavefront.views - bias.views)
            stage: RefinementStage = "applied" if found.is_helpful else "worse"
            if moved_rad > max(_MOVED_RAD, _MOVED_FRACTION * mean_rms(bias.views)):
                stage = "moved"
            if stage == "applied" and self._reconstructor.contradicts(wavefront):
                stage = "moved"
            if stage != "applied":
                wavefront = self._reconstructor.solve(displacement, sample=sample)
            applied = bias.displacement if stage == "applied" else None
            state = RefinementState(stage, time_s - found.time_s, moved_rad, bias=applied)
        is_other = state.bias is None and self._reconstructor.contradicts(wavefront)
        if is_other:
            wavefront = self._reconstructor.solve(displacement)
        assumed = Assumptions(None if is_other else found.sample, state, is_other)
        self._wavefronts = wavefront, wavefront if self._wavefronts is None else self._wavefronts[0]
        self._newest = Solved(displacement, time_s, assumed)
        self._something_new.set()
        return wavefront, assumed

    def solve_single(self, displacement: Displacement, *, is_foreign: bool) -> tuple[Wavefront, Assumptions]:
        """Reconstruct a frame that is not live, with its own search if it `is_foreign` or contradicts the sample."""
        sample = self._estimator.sample_of(displacement, None if is_foreign else self._found.sample)
        return self._estimator.solve(displacement, sample=sample, rounds=ROUNDS if self._refines else 0)

    def as_before(self, time_s: float) -> Assumptions:
        """Return the assumptions of the previous frame, for a skipped frame exposed at `time_s`."""
        before = self._newest
        if before is None:
            return Assumptions(self._found.sample, self._uncorrected())
        refinement = before.assumed.refinement
        aged = replace(refinement, age_s=refinement.age_s + time_s - before.time_s)
        return before.assumed._replace(refinement=aged)

    def _uncorrected(self) -> RefinementState:
        """State of a frame before the first bias."""
        if not self._refines:
            return RefinementState()
        problem = self._found.problem
        return RefinementState("failed" if problem else "preparing", problem=problem)

    def _work(self, background_estimator: BackgroundEstimatorProcess) -> None:
        """Have the newest frame searched again and again, with a rest as long as the work, or until it changes."""
        if sys.platform == "linux":  # threads have their own priority only here
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICENESS)
        try:
            background_estimator.prepare()
            while not self._closing.is_set():
                if self._something_new.wait(_WAIT_S) and self._newest is not None:
                    self._something_new.clear()
                    newest, begin_s, is_still = self._newest, time.monotonic(), self._is_still()
                    if not is_still and self._wavefronts is not None:
                        self._searched = self._wavefronts[0]
                    found = background_estimator.find(newest._replace(is_still=is_still))
                    self._use(found, newest)
                    self._look_for_absorption(newest.measured)
                    work_s = min(time.monotonic() - begin_s, _CORRECTION_REST_S)
                    self._rest(work_s if self._refines else max(work_s, found.rest_s), max(work_s, found.idle_s))
        except ReconstructionError as error:
            self._is_refused = True
            self._give_up(str(error))
        except (EOFError, OSError):
            self._give_up(_ENDED)
            if not self._closing.is_set():  # else it was killed
                sys.stderr.write(f"svwfs: {_ENDED}\n")
        except Exception as error:
            self._give_up(str(error))
            if not self._closing.is_set():  # else Python may end
                raise
        finally:
            background_estimator.close()

    def _give_up(self, problem: str) -> None:
        """Let frames go on with the sample found last, or with any wavefront: nobody is to wait for more."""
        self._found = Found(self._found.sample or FREE, problem=problem)

    def _use(self, found: Found, newest: Solved) -> None:
        """Use what was found for the frames that follow, after what depends on the layers is prepared."""
        sample, before = found.sample, self._found.sample
        if sample is not None and before is not None and _are_alike(sample, before, 0.0):
            found = found._replace(sample=before)  # a copy would count as another sample
        elif sample is not None:
            with suppress(ReconstructionError):  # of this frame
                made = self._reconstructor.solve(newest.measured, sample=sample)
                self._reconstructor.contradicts(made)
                made.sigma()
        self._found = found

    def _look_for_absorption(self, measured: Displacement) -> None:
        """Find whether the frames that follow are registered as behind a sample that absorbs; first prepare that."""
        absorbs = self._reconstructor.shows_absorption(measured)
        if absorbs != measured.absorbs:
            self._found = self._found._replace(bias=None)  # that of the other way to register
            _ = self._reconstructor.absorbing
        self.absorbs = absorbs

    def _rest(self, at_least_s: float, at_most_s: float) -> None:
        """Wait until something changes, and no longer if frames lack a sample or correction that could be found."""
        begin_s = time.monotonic()
        while (rested_s := time.monotonic() - begin_s) < at_most_s and not self._closing.is_set():
            assumed = None if self._newest is None else self._newest.assumed
            if assumed and (assumed.is_other or assumed.refinement.stage in {"preparing", "moved"}):
                return
            if rested_s >= at_least_s and not self._is_still():
                return
            self._closing.wait(min(at_most_s - rested_s, _WAIT_S))

    def _is_still(self) -> bool:
        """True if the wavefront has not changed by more than from frame to frame.

        Behind the same layers, which each frame is tested for, a change matters to a correction only.
        """
        searched, frames = self._searched, self._wavefronts
        if searched is None or frames is None:
            return False
        newest, before = frames
        if newest.sample.ratios and not self._refines:
            return True
        moved_rad, noise_rad = (mean_rms(newest.views - other.views) for other in (searched, before))
        return not moved_rad > _NOISES * noise_rad + _STILL_RAD
