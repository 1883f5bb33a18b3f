"""Refinement beside the live view: a thread of low priority finds the bias, and the newest bias corrects every frame.

A round takes some tenths of a second, in which the wavefront changes little while the sample drifts. When it has
changed much, the bias of a wavefront that is gone would do harm: then frames stay as they are until the next is found.
"""

from __future__ import annotations

import math
import os
import sys
import threading
from dataclasses import dataclass, field, replace
from typing import Literal

from app.bench.config import Bench
from app.measurement.imaging_model import BenchModel
from reconstruction.arrays import Floats
from reconstruction.displacement import Displacement
from reconstruction.errors import ReconstructionError
from reconstruction.pipeline import Reconstructor
from reconstruction.refinement import Bias, Refinement, distance_rad, mean_rms
from reconstruction.wavefront import Wavefront

_MOVED_FRACTION = 0.5  # of the RMS of the wavefront at which the bias was found: beyond, it is no better than none
_MOVED_RAD = 0.1  # but for a wavefront that is nearly flat
_NICENESS = 10
_WAIT_S = 0.2

RefinementStage = Literal["off", "preparing", "applied", "moved", "failed"]


@dataclass(frozen=True, slots=True)
class RefinementState:
    """Whether a frame has been corrected, and by what."""

    stage: RefinementStage = "off"
    age_s: float = math.nan  # from the frame at which the bias was found to this one
    moved_rad: float = math.nan  # by how much the wavefront has changed since, mean over the views
    problem: str = ""  # why it has failed
    bias: Floats | None = field(default=None, compare=False, repr=False)  # as applied, px; see `Reconstructor.solve`


@dataclass(frozen=True, slots=True, eq=False)
class _Found:
    bias: Bias
    time_s: float


class LiveRefinement:
    """Corrects the frames of one reconstructor; its thread ends soon after `close`."""

    def __init__(self, bench: Bench, reconstructor: Reconstructor) -> None:
        """Make the model, which takes some tenths of a second in which no other thread runs; then begin."""
        self._reconstructor = reconstructor
        self._newest: tuple[Wavefront, float] | None = None  # one slot each way, written by one thread
        self._found: _Found | None = None
        self._problem = ""
        self._state = RefinementState("preparing")  # of the frame before
        self._something_new, self._closing = threading.Event(), threading.Event()
        try:
            model = BenchModel(bench, reconstructor)
        except (ReconstructionError, ValueError) as error:  # a reference of which no model can be made
            self._problem = str(error)
            return
        threading.Thread(target=self._work, args=(model,), name="refinement", daemon=True).start()

    def close(self) -> None:
        """Begin no further round."""
        self._closing.set()

    def refine(self, displacement: Displacement, time_s: float) -> tuple[Wavefront, RefinementState]:
        """Reconstruct a frame exposed at `time_s`, corrected by the newest bias if that is any good for it."""
        found = self._found
        if found is None:
            wavefront = self._reconstructor.solve(displacement)
            state = RefinementState("failed" if self._problem else "preparing", problem=self._problem)
        else:
            wavefront = self._reconstructor.solve(displacement, bias=found.bias.displacement)
            moved_rad = distance_rad(wavefront.views, found.bias.views)
            limit_rad = max(_MOVED_RAD, _MOVED_FRACTION * mean_rms(found.bias.views))
            is_near = moved_rad <= limit_rad
            if not is_near:
                wavefront = self._reconstructor.solve(displacement)
            state = RefinementState(
                "applied" if is_near else "moved",
                time_s - found.time_s,
                moved_rad,
                bias=found.bias.displacement if is_near else None,
            )
        self._newest, self._state = (wavefront, time_s), state
        self._something_new.set()
        return wavefront, state

    def as_before(self, time_s: float) -> RefinementState:
        """What corrected the frame before, for one exposed at `time_s` that will be reconstructed only later."""
        if self._newest is None:
            return self._state
        return replace(self._state, age_s=self._state.age_s + time_s - self._newest[1])

    def _work(self, model: BenchModel) -> None:
        """Find the bias of the newest wavefront, again and again."""
        if sys.platform == "linux":  # where a thread has a priority of its own
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICENESS)
        try:
            refinement = Refinement(self._reconstructor, model)
            while not self._closing.is_set():
                if self._something_new.wait(_WAIT_S) and self._newest is not None:
                    self._something_new.clear()
                    wavefront, time_s = self._newest
                    try:
                        self._found = _Found(refinement.bias(wavefront), time_s)
                    except ReconstructionError as error:  # of this wavefront; the next may be better
                        self._problem = str(error)
        except Exception as error:
            self._found, self._problem = None, str(error)
            # Where the program ends meanwhile, the threads that share the work are gone before this one: no fault.
            is_over = isinstance(error, RuntimeError) and self._closing.is_set()
            if not (is_over or isinstance(error, ReconstructionError)):
                raise
