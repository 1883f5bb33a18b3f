"""Recorded frames through the estimator again.

The result of a frame does not depend on which other frames are reconstructed. With the recorded registration it starts
from the displacement that was recorded for the frame before, with another one from its result in a block of
`BLOCK_FRAMES`, whose first frame starts from zero. With the recorded settings the sample is the one assumed live, with
others that of the first frame of a block. A frame that contradicts it is searched on its own, for those after it, too;
so is one that was skipped live, where nothing was tested.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from app.errors import InputError
from app.measurement.calibration import Calibration
from app.measurement.estimator import Estimator, mask_sentence, method_sentence
from app.measurement.measurement import SKIPPED, Assumptions, LightState, Measurement, RefinementState
from app.recording.frame_array import DamagedFrame
from app.recording.frame_lines import FrameLine, assumed_sample
from app.recording.reader import Recording
from app.timing import Timings
from drivers.interface import Frame
from reconstruction.arrays import Floats
from reconstruction.displacement import Displacement
from reconstruction.errors import ReconstructionError
from reconstruction.layers.layered_wavefront import AssumedSample
from reconstruction.modes.field_modes import LegendreModes
from reconstruction.runtime.threads import one_blas_thread
from reconstruction.wavefront import Wavefront

Change = Callable[[Calibration], Calibration]

BLOCK_FRAMES = 128  # the frames of a block are computed together


class Reprocessing:
    """Reconstructs frames of a recording, each with its own bias and calibration, of which one is kept."""

    def __init__(self, recording: Recording, change: Change | None = None, *, rounds: int = 0) -> None:
        """Change each calibration, and refine in up to `rounds`; another registration uses no recorded bias."""
        self._recording, self._change, self._rounds = recording, change, rounds
        self._in_force: _InForce | None = None
        self._timings = Timings(1)

    def __call__(
        self, frames: Sequence[int] | None = None, on_damage: Callable[[int, str], None] | None = None
    ) -> Iterator[Measurement]:
        """Yield measurements of frames as `reprocess`; `on_damage` gets index and reason of each damaged one."""
        recording = self._recording
        chosen = range(len(recording)) if frames is None else frames
        before: Displacement | None = None
        previous = _seen_before(recording, chosen[0]) if chosen else None
        block = -1
        sample: AssumedSample | None = None
        with one_blas_thread():
            for index in chosen:
                if index // BLOCK_FRAMES != block:
                    block, before, sample = index // BLOCK_FRAMES, None, None
                try:
                    line, frame = recording.line(index), recording.frame(index)
                    if line.calibration is None:
                        yield _recorded(line, Measurement(frame, None, line.problem))
                        continue
                    if self._in_force is None or line.calibration != self._in_force.number:
                        self._in_force = self._prepare(line.calibration)
                        before = sample = None
                    in_force = self._in_force
                    start = _as_start(recording.start(index)) if in_force.registers_as_recorded else before
                except DamagedFrame as error:
                    if on_damage is None:
                        raise
                    on_damage(index, str(error))
                    continue
                follows = previous is not None and previous[0] + 1 == index
                made = in_force.estimator.measure(
                    frame,
                    partial(self._solve, in_force, line, sample),
                    self._timings,
                    start=start,
                    absorbs=line.absorbs if in_force.registers_as_recorded else None,
                    previous=previous[1] if previous is not None and follows else None,
                )
                before, previous = made.registered or before, (index, frame)
                sample = sample if made.wavefront is None else made.wavefront.sample
                yield _recorded(line, made)

    def mask_sentence(self, made: Measurement) -> str:
        """Say which registration was chosen, and what the mask hides of the newest frame; see `estimator`."""
        if self._in_force is None or made.wavefront is None:
            return ""
        prepared = self._in_force.estimator.reconstructor
        return "; ".join(filter(None, (method_sentence(prepared), mask_sentence(prepared, made.wavefront.sample))))

    def _prepare(self, number: int) -> _InForce:
        """Prepare a calibration of the recording, perhaps changed."""
        recorded = self._recording.calibration(number)
        try:
            calibration = recorded if self._change is None else self._change(recorded)
            estimator = Estimator(calibration, threads=1)
            _ = estimator.quality_checker
            if self._rounds:
                _ = estimator.refinement
        except (ReconstructionError, ValueError) as error:
            text = f"{self._recording.folder}: calibration {number} does not fit this bench: {error}"
            raise InputError(text) from error
        registers = _of_registration(calibration) == _of_registration(recorded)
        solves = registers and calibration.bench.reconstruction == recorded.bench.reconstruction
        if registers and not solves and calibration.bench.registration.warp is None:  # chosen for the reconstruction
            registers = recorded.reconstructor().registration == estimator.reconstructor.registration
        return _InForce(number, estimator, registers, solves)

    def _solve(
        self, in_force: _InForce, line: FrameLine, sample: AssumedSample | None, registered: Displacement
    ) -> tuple[Wavefront, Assumptions]:
        """Solve for a frame; `sample` is that of an earlier frame of the block, if there is one."""
        recording, estimator = self._recording, in_force.estimator
        if in_force.solves_as_recorded:  # frames were tested live, unless they were skipped
            sample = replace(assumed_sample(line.sample), allowed=1.0 if line.problem == SKIPPED else math.inf)
        known, sample = sample, estimator.sample_of(registered, sample)
        is_other = known is not None and sample is not known  # and the recorded bias is not its own
        if self._rounds or line.bias is None or is_other or not in_force.registers_as_recorded:
            return estimator.solve(registered, sample=sample, rounds=self._rounds)
        bias = recording.bias(line.bias)
        if bias.shape != registered.coefficients.shape:
            raise InputError(f"{recording.folder}: bias {line.bias} has other lenslets or field modes")
        age_s = math.nan if line.bias_age_s is None else line.bias_age_s
        wavefront = estimator.reconstructor.solve(registered, bias=bias, sample=sample)
        return wavefront, Assumptions(sample, RefinementState("applied", age_s, bias=bias))


def reprocess(
    recording: Recording, frames: Sequence[int] | None = None, change: Change | None = None
) -> Iterator[Measurement]:
    """Reconstruct recorded frames, by their indices in increasing order, or all; see `Reprocessing`.

    Frames that were skipped live are reconstructed, too; frames without a calibration have a problem instead.
    `InputError` if a frame or its calibration cannot be read, or does not fit the changed bench.
    """
    return Reprocessing(recording, change)(frames)


@dataclass(frozen=True, slots=True, eq=False)
class _InForce:
    number: int
    estimator: Estimator
    registers_as_recorded: bool
    solves_as_recorded: bool


def _recorded(line: FrameLine, made: Measurement) -> Measurement:
    current_a = line.light_current_a
    light = None if current_a is None else LightState(bool(line.is_light_on), current_a)
    return replace(made, lost=line.lost, light=light, index=line.index)


def _seen_before(recording: Recording, index: int) -> tuple[int, Frame] | None:
    """The frame before another, with its index; None if it has no calibration, or cannot be read."""
    try:
        has_calibration = recording.line(index - 1).calibration is not None
        return (index - 1, recording.frame(index - 1)) if has_calibration else None
    except InputError:
        return None


def _of_registration(calibration: Calibration) -> object:
    """Settings that affect the registration, in addition to dark and reference; the number of threads does not."""
    bench = calibration.bench
    return bench.sensor, calibration.lattice, bench.field, replace(bench.registration, threads=1)


def _as_start(coefficients: Floats | None) -> Displacement | None:
    """A starting point of coefficients (lenslet_row, lenslet_column, field_mode, xy), px."""
    if coefficients is None:
        return None
    shape = coefficients.shape
    unknown = np.full(shape[:2], np.nan)
    return Displacement(
        modes=LegendreModes(shape[2]),
        coefficients=coefficients,
        covariance_source=np.full((*shape, *shape[2:]), np.nan),
        outcome=np.zeros(shape[:2], np.int8),
        residual_rms=unknown,
        chi_square=unknown,
        range_used=unknown,
    )
