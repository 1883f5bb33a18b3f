"""Whether what comes of recorded frames now is what came of them then, to the last bit."""

from __future__ import annotations

from importlib.metadata import version
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.measurement.measurement import PASSED_OVER
from app.recording.reader import Recording
from app.recording.reprocess import Reprocessed
from reconstruction.refinement import mean_rms
from reconstruction.solve.modal import ModalSolution


class Verification:
    """Hears of every repeated frame and remembers the first that differs."""

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self._first = ""
        self.frames = 0  # that were reconstructed, or refused, when they were recorded
        self.different = 0

    def take(self, repeated: Reprocessed) -> None:
        """Compare one frame; one that was passed over when it was recorded says nothing."""
        if repeated.line.calibration is None or repeated.line.problem == PASSED_OVER:
            return
        self.frames += 1
        found = _differences(self._recording, repeated)
        if found:
            self.different += 1
            self._first = self._first or f"frame {repeated.line.index}: {found}"

    @property
    def passes(self) -> bool:
        """Whether there was something to compare, and nothing differs."""
        return self.frames > 0 and not self.different

    @property
    def sentence(self) -> str:
        """What there is to say of all of them."""
        if not self.frames:
            return "none of these frames was reconstructed when it was recorded: there is nothing to compare"
        if not self.different:
            return f"{self.frames} frames, each bit-identical to what was recorded"
        then, now = self._recording.run.get("versions", {}).get("svwfs", "an unknown version"), version("svwfs")
        software = f"recorded by svwfs {then}, replayed by {now}" if then != now else f"both by svwfs {now}"
        return f"{self.different} of {self.frames} frames differ from what was recorded; {self._first} ({software})"


def _differences(recording: Recording, repeated: Reprocessed) -> str:
    """In what a frame differs, and by how much; empty when in nothing."""
    line, wavefront = repeated.line, repeated.wavefront
    if line.problem != repeated.problem:
        return f'the problem was "{line.problem}" and is "{repeated.problem}"'
    if wavefront is None or repeated.registered is None:
        return ""
    solution = wavefront.solution
    found = [
        _difference(recording.displacement(line.index), repeated.registered.coefficients, "displacements", "px"),
        _difference(np.array(line.rms_rad, np.float64), np.array(mean_rms(wavefront.views)), "the RMS", "rad"),
    ]
    if isinstance(solution, ModalSolution):
        found.append(_difference(recording.coefficients(line.index), solution.coefficients, "coefficients", "rad"))
    return ", ".join(part for part in found if part)


def _difference(then: NDArray[Any] | None, now: NDArray[Any], what: str, unit: str) -> str:
    if then is None:
        return f"{what} were not recorded"
    if then.shape != now.shape:
        return f"{what} have another shape"
    if np.array_equal(then, now, equal_nan=True):
        return ""
    if not np.array_equal(np.isnan(then), np.isnan(now)):
        return f"{what} of other lenslets are known"
    return f"{what} by up to {np.nanmax(np.abs(then - now)):.2g} {unit}"
