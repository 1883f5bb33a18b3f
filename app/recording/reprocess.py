"""Recorded frames through the pipeline again: the same software makes the same results, bit for bit.

The result of a frame does not depend on which other frames are reconstructed: with the recorded registration it starts
where it did live, with another one in a block of `BLOCK_FRAMES` whose first frame starts from zero displacement. With
the recorded settings the sample is the one assumed live, with others that of the first frame of a block.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from app.bench.imaging_model import BenchModel
from app.errors import InputError
from app.measurement.assumptions import mask_sentence
from app.measurement.calibration import Calibration
from app.recording.frame_array import DamagedFrame
from app.recording.frame_lines import FrameLine, assumed_sample
from app.recording.reader import Recording
from reconstruction.arrays import Counts, Floats
from reconstruction.displacement import Displacement
from reconstruction.errors import ReconstructionError
from reconstruction.layers.layered_wavefront import FREE, AssumedSample
from reconstruction.modes.field_modes import LegendreModes
from reconstruction.pipeline import Reconstructor
from reconstruction.quality.frame_quality import FrameJudge
from reconstruction.quality.verdict import Quality, sequence_quality
from reconstruction.refinement import Refinement
from reconstruction.runtime.threads import one_blas_thread
from reconstruction.wavefront import Wavefront

Change = Callable[[Calibration], Calibration]
_Seen = tuple[FrameLine, Counts]

BLOCK_FRAMES = 128  # the frames of a block are computed together


@dataclass(frozen=True, slots=True, eq=False)
class Reprocessed:
    """A recorded frame and its new results."""

    line: FrameLine
    wavefront: Wavefront | None
    problem: str  # why there is no wavefront; empty if there is one
    registered: Displacement | None  # before the bias
    calibration: Calibration | None  # after the change
    bias_age_s: float | None = None  # of the subtracted bias; None if none was subtracted
    quality: Quality = Quality()
    mask_note: str = ""  # see `mask_sentence`

    @property
    def is_refined(self) -> bool:
        """True if a bias was subtracted."""
        return self.bias_age_s is not None


class Reprocessing:
    """Reconstructs frames of one recording, each with its own calibration, starting point and bias.

    The newest calibration is prepared once for all calls.

    Parameters
    ----------
    recording
        The recording.
    change
        Changes each calibration. If the registration differs, each frame starts from the one before in its block, and
        no bias is subtracted, because it belongs to the recorded registration.
    rounds
        Rounds of refinement at most, each frame with its own bias instead of the recorded one.
    """

    def __init__(self, recording: Recording, change: Change | None = None, *, rounds: int = 0) -> None:
        self._recording, self._change, self._rounds = recording, change, rounds
        self._in_force: _InForce | None = None

    def __call__(
        self, frames: Sequence[int] | None = None, on_damage: Callable[[int, str], None] | None = None
    ) -> Iterator[Reprocessed]:
        """Yield the results of frames in increasing order; see `reprocess`.

        With `on_damage`, a damaged frame is left out, and `on_damage` gets its index and the reason.
        """
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
                    line, pixels = recording.line(index), recording.pixels(index)
                    if line.calibration is None:
                        yield Reprocessed(line, None, line.problem, None, None)
                        continue
                    if self._in_force is None or line.calibration != self._in_force.number:
                        self._in_force = _InForce.of(recording, line.calibration, self._change, self._rounds)
                        before = sample = None
                    in_force = self._in_force
                    start = _as_start(recording.start(index)) if in_force.registers_as_recorded else before
                except DamagedFrame as error:
                    if on_damage is None:
                        raise
                    on_damage(index, str(error))
                    continue
                made = in_force.reconstruct(recording, line, pixels, start, previous, sample)
                before, previous = made.registered or before, (line, pixels)
                sample = sample or (None if made.wavefront is None else made.wavefront.sample)
                yield made


def reprocess(
    recording: Recording, frames: Sequence[int] | None = None, change: Change | None = None
) -> Iterator[Reprocessed]:
    """Reconstruct recorded frames; see `Reprocessing`.

    Frames that were skipped live are reconstructed, too; frames without a calibration have a problem instead.

    Parameters
    ----------
    recording, change
        As for `Reprocessing`.
    frames
        Indices in increasing order; all without.

    Yields
    ------
    Reprocessed
        Results of one frame.

    Raises
    ------
    InputError
        If a frame or its calibration cannot be read, or does not fit the changed bench.
    """
    return Reprocessing(recording, change)(frames)


@dataclass(frozen=True, slots=True, eq=False)
class _InForce:
    """One calibration of a recording, perhaps changed, and its reconstructor."""

    number: int
    calibration: Calibration
    reconstructor: Reconstructor
    judge: FrameJudge
    registers_as_recorded: bool
    solves_as_recorded: bool
    refinement: Refinement | None
    rounds: int

    @classmethod
    def of(cls, recording: Recording, number: int, change: Change | None, rounds: int) -> _InForce:
        recorded = recording.calibration(number)
        try:
            calibration = recorded if change is None else change(recorded)
            registers = _of_registration(calibration) == _of_registration(recorded)
            solves = registers and calibration.bench.reconstruction == recorded.bench.reconstruction
            reconstructor = calibration.reconstructor()
            judge = calibration.judge(reconstructor)
            refinement = None
            if rounds:  # in one thread, because threads add the model's light in an order of their own
                refinement = Refinement(reconstructor, BenchModel(calibration.bench, reconstructor, threads=1))
            return cls(number, calibration, reconstructor, judge, registers, solves, refinement, rounds)
        except (ReconstructionError, ValueError) as error:  # ValueError: the reference does not allow a model
            raise InputError(f"{recording.folder}: calibration {number} does not fit this bench: {error}") from error

    def reconstruct(
        self,
        recording: Recording,
        line: FrameLine,
        pixels: Counts,
        start: Displacement | None,
        previous: _Seen | None,
        sample: AssumedSample | None,
    ) -> Reprocessed:
        """Reconstruct a frame; `sample` is that of an earlier frame of the block, if there is one."""
        try:
            registered = self.reconstructor.register(pixels, start=start)
            if self.solves_as_recorded:
                sample = _recorded_sample(recording, line)
            elif sample is None:
                sample = self.reconstructor.find_sample(registered)
            wavefront, bias_age_s = self._solve(recording, line, registered, sample)
        except ReconstructionError as error:
            return Reprocessed(line, None, str(error), None, self.calibration)
        quality = self.judge(pixels, wavefront.displacement) | _beside(previous, line, pixels)
        note = mask_sentence(self.reconstructor, sample)
        return Reprocessed(line, wavefront, "", registered, self.calibration, bias_age_s, quality, note)

    def _solve(
        self, recording: Recording, line: FrameLine, registered: Displacement, sample: AssumedSample
    ) -> tuple[Wavefront, float | None]:
        """Wavefront, and age of the bias that was subtracted, s; None without one."""
        if self.refinement is not None:
            rounds = list(self.refinement.rounds(registered, self.rounds, sample))
            return (
                (rounds[-1].wavefront, 0.0) if rounds else (self.reconstructor.solve(registered, sample=sample), None)
            )
        if line.bias is None or not self.registers_as_recorded:
            return self.reconstructor.solve(registered, sample=sample), None
        bias = recording.bias(line.bias)
        if bias.shape != registered.coefficients.shape:
            raise InputError(f"{recording.folder}: bias {line.bias} has other lenslets or field modes")
        age_s = math.nan if line.bias_age_s is None else line.bias_age_s
        return self.reconstructor.solve(registered, bias=bias, sample=sample), age_s


def _recorded_sample(recording: Recording, line: FrameLine) -> AssumedSample:
    """Sample assumed for a frame live; any wavefront before one was found."""
    try:
        return FREE if line.sample is None else assumed_sample(line.sample)
    except ValueError as error:
        raise InputError(f"{recording.folder}: the line of frame {line.index} is damaged: {error}") from error


def _seen_before(recording: Recording, index: int) -> _Seen | None:
    """The frame before another; None if it has no calibration, or cannot be read."""
    try:
        line = recording.line(index - 1)
        return None if line.calibration is None else (line, recording.pixels(index - 1))
    except InputError:
        return None


def _beside(previous: _Seen | None, line: FrameLine, pixels: Counts) -> Quality:
    """Quality of a frame beside the recorded one before; the camera counts from 0 after a restart."""
    if previous is None or previous[0].index + 1 != line.index or previous[0].camera_index >= line.camera_index:
        return Quality()
    return sequence_quality(previous[1], pixels, line.camera_time_s - previous[0].camera_time_s)


def _of_registration(calibration: Calibration) -> object:
    """Settings that affect the registration, besides dark and reference; the number of threads does not."""
    bench = calibration.bench
    return bench.sensor, calibration.lattice, bench.field, replace(bench.registration, threads=1)


def _as_start(coefficients: Floats | None) -> Displacement | None:
    """A starting point; only its coefficients are used."""
    if coefficients is None:
        return None
    shape = coefficients.shape
    unknown = np.full(shape[:2], np.nan)
    return Displacement(
        modes=LegendreModes(shape[2]),
        coefficients=coefficients,
        covariance=np.full((*shape, *shape[2:]), np.nan),
        outcome=np.zeros(shape[:2], np.int8),
        residual_rms=unknown,
        chi_square=unknown,
        range_used=unknown,
    )
