"""The frames of a recording through the pipeline again: the same software makes the same of them, bit for bit."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from app.calibration import one_blas_thread
from app.recording.frame_line import FrameLine
from app.recording.reader import Recording
from reconstruction.displacement import Displacement
from reconstruction.errors import ReconstructionError
from reconstruction.field_modes import LegendreModes
from reconstruction.geometry import Floats
from reconstruction.pipeline import Reconstructor
from reconstruction.wavefront import Wavefront


@dataclass(frozen=True, slots=True, eq=False)
class Repeated:
    """A recorded frame and what has become of it this time."""

    line: FrameLine
    wavefront: Wavefront | None
    problem: str  # why there is no wavefront; empty when there is one
    registered: Displacement | None  # before the bias


def repeated(recording: Recording, frames: range | None = None) -> Iterator[Repeated]:
    """Reconstruct frames, all or some in their order, each with its own calibration, start and bias.

    Frames that were passed over are reconstructed, too; those that had no calibration have a problem.
    """
    number, reconstructor = None, None
    before: tuple[int, Displacement] | None = None
    with one_blas_thread():
        for index in range(len(recording)) if frames is None else frames:
            line = recording.line(index)
            if line.calibration != number and line.calibration is not None:
                number, reconstructor = line.calibration, recording.calibration(line.calibration).reconstructor()
            if line.calibration is None or reconstructor is None:
                yield Repeated(line, None, line.problem, None)
                continue
            if before is not None and before[0] == line.start:
                start: Displacement | None = before[1]
            else:
                recorded = recording.start(index)
                start = None if recorded is None else _as_start(recorded)
            made = _reconstruct(recording, reconstructor, line, start)
            if made.registered is not None:
                before = index, made.registered
            yield made


def _reconstruct(
    recording: Recording, reconstructor: Reconstructor, line: FrameLine, start: Displacement | None
) -> Repeated:
    try:
        registered = reconstructor.register(recording.pixels(line.index), start=start)
        bias = None if line.bias is None else recording.bias(line.bias)
        return Repeated(line, reconstructor.solve(registered, bias=bias), "", registered)
    except ReconstructionError as error:
        return Repeated(line, None, str(error), None)


def _as_start(coefficients: Floats) -> Displacement:
    """A displacement that is only to start from: of that, nothing but the coefficients counts."""
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
