"""Reconstruction of live frames, with what a finder finds meanwhile: the sample's layers and the estimator's bias.

If the wavefront has changed much since the bias was found, the old bias would do harm: frames stay uncorrected until
the next one is found.
"""

import os
import sys
import threading
import time
from contextlib import suppress
from dataclasses import replace
from subprocess import Popen

from app.measurement.estimator import Estimator
from app.measurement.finder import FinderProcess, Found, Solved
from app.measurement.measurement import Assumptions, RefinementStage, RefinementState
from reconstruction.displacement import Displacement
from reconstruction.errors import ReconstructionError
from reconstruction.layers.layered_wavefront import FREE
from reconstruction.runtime.background import NICENESS
from reconstruction.wavefront import Wavefront, mean_rms

_MOVED_FRACTION = 0.5  # of the RMS of the bias's wavefront; after a larger change the bias is useless
_MOVED_RAD = 0.1  # limit for a nearly flat wavefront
_REST_S = 1.0  # at most, after a search with a correction, which would grow old
_WAIT_S = 0.2
_ENDED = "the process that finds layers and corrections has ended: take the reference again"


class LiveSolver:
    """Solves for one estimator's frames; its thread ends soon after `close`."""

    def __init__(self, estimator: Estimator) -> None:
        """Start finder and thread if there is anything to find."""
        self._reconstructor = estimator.reconstructor
        searches = self._reconstructor.may_be_layered
        self._refines = estimator.calibration.bench.reconstruction.refine
        self._newest: Solved | None = None  # one slot each way, written by one thread
        self._found = Found(None if searches else FREE)
        self._something_new, self._closing = threading.Event(), threading.Event()
        self.prepares = searches or self._refines
        self._finder = FinderProcess(estimator) if self.prepares else None
        if self._finder is not None:
            threading.Thread(target=self._work, args=(self._finder,), name="live-solver", daemon=True).start()

    @property
    def process(self) -> Popen[bytes] | None:
        """The process of the finder, if it has one."""
        return None if self._finder is None else self._finder.process

    def close(self) -> None:
        """Stop at once."""
        self._closing.set()
        if self._finder is not None:
            self._finder.stop()

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
        self._newest = Solved(displacement, time_s, assumed)
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
        problem = self._found.problem
        return RefinementState("failed" if problem else "preparing", problem=problem)

    def _work(self, finder: FinderProcess) -> None:
        """Let the finder look at the newest frame again and again; it rests as long as it worked, or is idle."""
        if sys.platform == "linux":  # threads have their own priority only here
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICENESS)
        try:
            finder.prepare()
            while not self._closing.is_set():
                if self._something_new.wait(_WAIT_S) and self._newest is not None:
                    self._something_new.clear()
                    newest, begin_s = self._newest, time.monotonic()
                    found = finder.find(newest)
                    self._use(found, newest)
                    self._rest(max(min(time.monotonic() - begin_s, _REST_S), found.idle_s))
        except ReconstructionError as error:
            self._give_up(str(error))
        except (EOFError, OSError) as error:
            self._give_up(_ENDED)
            if not self._closing.is_set():  # else it was killed
                raise RuntimeError(_ENDED) from error
        except Exception as error:
            self._give_up(str(error))
            if not self._closing.is_set():  # else Python may end
                raise
        finally:
            finder.close()

    def _give_up(self, problem: str) -> None:
        """Let frames go on with the sample found last, or with any wavefront: nobody is to wait for more."""
        self._found = Found(self._found.sample or FREE, problem=problem)

    def _use(self, found: Found, newest: Solved) -> None:
        """Use what was found for the frames that follow, after what depends on the layers is prepared."""
        if found.sample is not None and found.sample is not self._found.sample:
            with suppress(ReconstructionError):  # of this frame
                self._reconstructor.solve(newest.measured, sample=found.sample).sigma()
        self._found = found

    def _rest(self, seconds: float) -> None:
        """Wait, unless frames lack a correction that could be found."""
        end_s = time.monotonic() + seconds
        while (left_s := end_s - time.monotonic()) > 0 and not self._closing.is_set():
            if self._newest is not None and self._newest.assumed.refinement.stage in {"preparing", "moved"}:
                return
            self._closing.wait(min(left_s, _WAIT_S))
