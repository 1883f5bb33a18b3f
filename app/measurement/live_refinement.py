"""Live refinement: a low-priority thread estimates the bias, and the newest bias corrects every frame.

A round takes some tenths of a second. If the wavefront has changed much meanwhile, the old bias would do harm: frames
stay uncorrected until the next one is found. So they do near a wavefront whose correction worsened the misfit of the
modelled displacements.
"""

import math
import os
import sys
import threading
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple

from app.bench.config import Bench
from app.bench.imaging_model import BenchModel
from reconstruction.arrays import Floats
from reconstruction.displacement import Displacement
from reconstruction.errors import ReconstructionError
from reconstruction.pipeline import Reconstructor
from reconstruction.refinement import Bias, Refinement, distance_rad, mean_rms
from reconstruction.wavefront import Wavefront

_MOVED_FRACTION = 0.5  # of the RMS of the bias's wavefront; after a larger change the bias is useless
_MOVED_RAD = 0.1  # limit for a nearly flat wavefront
_HARM = 1.2  # rise of the misfit by a harmful correction; noise stays below
_HARM_PX = 0.003  # added, for a misfit of nearly 0
_NICENESS = 10
_WAIT_S = 0.2

RefinementStage = Literal["off", "preparing", "applied", "moved", "worse", "failed"]


@dataclass(frozen=True, slots=True)
class RefinementState:
    """Correction of one frame."""

    stage: RefinementStage = "off"
    age_s: float = math.nan  # from the bias's frame to this one
    moved_rad: float = math.nan  # change of the wavefront since the bias's frame, mean RMS over the views
    problem: str = ""  # reason of a failure
    bias: Floats | None = field(default=None, compare=False, repr=False)  # as applied, px; see `Reconstructor.solve`


class _Refined(NamedTuple):
    """A frame's result."""

    wavefront: Wavefront
    measured: Displacement  # before the bias
    time_s: float
    stage: RefinementStage


class _Found(NamedTuple):
    """A bias, and whether corrections near it help."""

    bias: Bias
    time_s: float
    helps: bool


class LiveRefinement:
    """Refinement of one reconstructor's frames; its thread ends soon after `close`."""

    def __init__(self, bench: Bench, reconstructor: Reconstructor) -> None:
        """Build the model, which blocks all threads for some tenths of a second, and start the thread."""
        self._reconstructor = reconstructor
        self._newest: _Refined | None = None  # one slot each way, written by one thread
        self._bias: _Found | None = None
        self._problem = ""
        self._state = RefinementState("preparing")  # of the previous frame
        self._something_new, self._closing = threading.Event(), threading.Event()
        try:
            model = BenchModel(bench, reconstructor)
        except (ReconstructionError, ValueError) as error:  # the reference does not allow a model
            self._problem = str(error)
            return
        threading.Thread(target=self._work, args=(model,), name="refinement", daemon=True).start()

    def close(self) -> None:
        """Stop after the current round."""
        self._closing.set()

    def refine(self, displacement: Displacement, time_s: float) -> tuple[Wavefront, RefinementState]:
        """Reconstruct a frame exposed at `time_s`, corrected by the newest bias if it applies."""
        newest = self._bias  # read once: the thread may replace it
        if newest is None:
            wavefront = self._reconstructor.solve(displacement)
            state = RefinementState("failed" if self._problem else "preparing", problem=self._problem)
        else:
            bias = newest.bias
            wavefront = self._reconstructor.solve(displacement, bias=bias.displacement)
            moved_rad = distance_rad(wavefront.views, bias.views)
            stage: RefinementStage = "applied" if newest.helps else "worse"
            if moved_rad > max(_MOVED_RAD, _MOVED_FRACTION * mean_rms(bias.views)):
                stage = "moved"
            if stage != "applied":
                wavefront = self._reconstructor.solve(displacement)
            applied = bias.displacement if stage == "applied" else None
            state = RefinementState(stage, time_s - newest.time_s, moved_rad, bias=applied)
        self._newest, self._state = _Refined(wavefront, displacement, time_s, state.stage), state
        self._something_new.set()
        return wavefront, state

    def as_before(self, time_s: float) -> RefinementState:
        """Return the previous frame's correction, for a skipped frame exposed at `time_s`."""
        if self._newest is None:
            return self._state
        return replace(self._state, age_s=self._state.age_s + time_s - self._newest.time_s)

    def _work(self, model: BenchModel) -> None:
        """Estimate the bias of the newest wavefront repeatedly."""
        if sys.platform == "linux":  # threads have their own priority only here
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICENESS)
        try:
            refinement, uncorrected_px = Refinement(self._reconstructor, model), math.inf
            while not self._closing.is_set():
                if self._something_new.wait(_WAIT_S) and self._newest is not None:
                    self._something_new.clear()
                    newest = self._newest
                    if newest.stage == "worse":  # until the wavefront changes
                        continue
                    try:
                        bias = refinement.bias(newest.wavefront)
                        misfit_px = bias.misfit_px(newest.measured)
                        if newest.stage != "applied":
                            uncorrected_px = misfit_px
                        self._bias = _Found(bias, newest.time_s, misfit_px <= _HARM * uncorrected_px + _HARM_PX)
                    except ReconstructionError as error:  # the next wavefront may succeed
                        self._problem = str(error)
        except Exception as error:
            self._bias, self._problem = None, str(error)
            # At interpreter exit the worker pool ends before this thread: not a fault.
            is_over = isinstance(error, RuntimeError) and self._closing.is_set()
            if not (is_over or isinstance(error, ReconstructionError)):
                raise
