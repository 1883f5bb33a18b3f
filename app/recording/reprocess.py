"""Recorded frames through the pipeline again: the same software makes the same results, bit for bit."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from app.errors import InputError
from app.measurement.calibration import Calibration
from app.recording.frame_lines import FrameLine
from app.recording.reader import Recording
from reconstruction.arrays import Counts, Floats
from reconstruction.displacement import Displacement
from reconstruction.errors import ReconstructionError
from reconstruction.modes.field_modes import LegendreModes
from reconstruction.pipeline import Reconstructor
from reconstruction.quality.frame_quality import FrameJudge
from reconstruction.quality.sequence import sequence_quality
from reconstruction.quality.verdict import Quality
from reconstruction.runtime.threads import one_blas_thread
from reconstruction.wavefront import Wavefront

Change = Callable[[Calibration], Calibration]
_Seen = tuple[FrameLine, Counts]


@dataclass(frozen=True, slots=True, eq=False)
class Reprocessed:
    """A recorded frame and its new results."""

    line: FrameLine
    wavefront: Wavefront | None
    problem: str  # why there is no wavefront; empty if there is one
    registered: Displacement | None  # before the bias
    calibration: Calibration | None  # after the change
    is_refined: bool = False  # whether a bias was subtracted
    quality: Quality = Quality()


def reprocess(
    recording: Recording, frames: Sequence[int] | None = None, change: Change | None = None
) -> Iterator[Reprocessed]:
    """Reconstruct recorded frames, each with its own calibration, starting point and bias.

    Frames that were skipped live are reconstructed, too; frames without a calibration have a problem instead.

    Parameters
    ----------
    recording
        The recording.
    frames
        Indices in increasing order; all without.
    change
        Changes each calibration. If the registration differs, each frame starts from the one before, and no bias is
        subtracted, because it belongs to the recorded registration.

    Yields
    ------
    Reprocessed
        Results of one frame.

    Raises
    ------
    InputError
        If a frame or its calibration cannot be read, or does not fit the changed bench.
    """
    in_force: _InForce | None = None
    before: Displacement | None = None
    previous: _Seen | None = None
    with one_blas_thread():
        for index in range(len(recording)) if frames is None else frames:
            line = recording.line(index)
            if line.calibration is None:
                yield Reprocessed(line, None, line.problem, None, None)
                continue
            if in_force is None or line.calibration != in_force.number:
                in_force, before = _InForce.of(recording, line.calibration, change), None
            start = _as_start(recording.start(index)) if in_force.registers_as_recorded else before
            pixels = recording.pixels(index)
            made = in_force.reconstruct(recording, line, pixels, start, previous)
            before, previous = made.registered or before, (line, pixels)
            yield made


@dataclass(frozen=True, slots=True, eq=False)
class _InForce:
    """One calibration of a recording, perhaps changed, and its reconstructor."""

    number: int
    calibration: Calibration
    reconstructor: Reconstructor
    judge: FrameJudge
    registers_as_recorded: bool

    @classmethod
    def of(cls, recording: Recording, number: int, change: Change | None) -> _InForce:
        recorded = recording.calibration(number)
        try:
            calibration = recorded if change is None else change(recorded)
            same = _of_registration(calibration) == _of_registration(recorded)
            reconstructor = calibration.reconstructor()
            return cls(number, calibration, reconstructor, calibration.judge(reconstructor), same)
        except ReconstructionError as error:
            raise InputError(f"{recording.folder}: calibration {number} does not fit this bench: {error}") from error

    def reconstruct(
        self, recording: Recording, line: FrameLine, pixels: Counts, start: Displacement | None, previous: _Seen | None
    ) -> Reprocessed:
        try:
            registered = self.reconstructor.register(pixels, start=start)
            bias = recording.bias(line.bias) if self.registers_as_recorded and line.bias is not None else None
            if bias is not None and bias.shape != registered.coefficients.shape:
                raise InputError(f"{recording.folder}: bias {line.bias} has other lenslets or field modes")
            wavefront = self.reconstructor.solve(registered, bias=bias)
        except ReconstructionError as error:
            return Reprocessed(line, None, str(error), None, self.calibration)
        quality = self.judge(pixels, wavefront.displacement) | _beside(previous, line, pixels)
        is_refined = bias is not None
        return Reprocessed(line, wavefront, "", registered, self.calibration, is_refined=is_refined, quality=quality)


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
