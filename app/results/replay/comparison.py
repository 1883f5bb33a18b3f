"""New results of recorded frames beside the recorded ones."""

from importlib.metadata import version
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.measurement.measurement import SKIPPED
from app.progress import counted
from app.recording.reader import Recording
from app.recording.reprocess import Reprocessed
from app.results.view_quality import Variable, about
from reconstruction.arrays import Floats
from reconstruction.geometry import Field
from reconstruction.refinement import mean_rms
from reconstruction.solve.modal_solution import ModalSolution
from reconstruction.wavefront import Wavefront, rms

_VIEW = ("view_row", "view_column")


class Verification:
    """Compares frames with what was recorded, to the last bit, and remembers the first that differs."""

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self._first = ""
        self.frames = 0  # frames that were reconstructed, or refused, live
        self.different = 0

    def take(self, frame: Reprocessed) -> None:
        """Compare one frame, unless it was skipped live."""
        if frame.line.calibration is None or frame.line.problem == SKIPPED:
            return
        self.frames += 1
        differences = _differences(self._recording, frame)
        if differences:
            self.different += 1
            self._first = self._first or f"frame {frame.line.index}: {differences}"

    @property
    def passes(self) -> bool:
        """True if there was something to compare, and nothing differs."""
        return self.frames > 0 and not self.different

    @property
    def sentence(self) -> str:
        """The result in words."""
        if not self.frames:
            return "none of these frames was reconstructed when it was recorded: there is nothing to compare"
        if not self.different:
            return f"{counted(self.frames)}, each bit-identical to what was recorded"
        versions, now = self._recording.run.get("versions"), version("svwfs")
        then = versions.get("svwfs") if isinstance(versions, dict) else "an unknown version"
        software = f"recorded by svwfs {then}, replayed by {now}" if then != now else f"both by svwfs {now}"
        return f"{self.different} of {self.frames} frames differ from what was recorded; {self._first} ({software})"


def _differences(recording: Recording, frame: Reprocessed) -> str:
    """Differences and their size; empty if there are none."""
    line, wavefront = frame.line, frame.wavefront
    if line.problem != frame.problem:
        return f'the problem was "{line.problem}" and is "{frame.problem}"'
    if wavefront is None or frame.registered is None:
        return ""
    solution = wavefront.solution
    differences = [
        _difference(recording.displacement(line.index), frame.registered.coefficients, "displacements", "px"),
        _difference(np.array(line.rms_rad, np.float64), np.array(mean_rms(wavefront.views)), "the RMS", "rad"),
    ]
    if isinstance(solution, ModalSolution):
        recorded = recording.coefficients(line.index)
        differences.append(_difference(recorded, solution.coefficients, "coefficients", "rad"))
    return ", ".join(part for part in differences if part)


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


class Comparison:
    """Means over the frames that have a wavefront with both benches."""

    def __init__(self) -> None:
        self.frames = 0
        self.field: Field | None = None
        self._sums: list[Floats] = []

    def take(self, then: Reprocessed, now: Reprocessed) -> dict[str, Variable]:
        """Add a frame; return additional variables for its results."""
        if then.wavefront is None or now.wavefront is None or not are_alike(then.wavefront, now.wavefront):
            return {}
        values = [rms(then.wavefront.views), rms(now.wavefront.views), rms(now.wavefront.views - then.wavefront.views)]
        self._sums = [total + value for total, value in zip(self._sums or [np.zeros(1)] * 3, values, strict=True)]
        self.frames, self.field = self.frames + 1, now.wavefront.field
        return {
            "recorded_rms": (_VIEW, values[0], about("rad", "RMS of each view's wavefront with the recorded bench")),
            "difference_rms": (_VIEW, values[2], about("rad", "RMS difference of each view's wavefront from it")),
        }

    @property
    def recorded_rms_rad(self) -> Floats:
        """RMS with the recorded bench, (view_row, view_column)."""
        return self._sums[0] / self.frames

    @property
    def rms_rad(self) -> Floats:
        """RMS with the other bench, (view_row, view_column)."""
        return self._sums[1] / self.frames

    @property
    def difference_rms_rad(self) -> Floats:
        """RMS of the difference where both wavefronts are known, without piston, (view_row, view_column)."""
        return self._sums[2] / self.frames


def are_alike(one: Wavefront, other: Wavefront) -> bool:
    """True if views and lenslets are the same, so that the wavefronts can be subtracted."""
    return (
        one.views.shape == other.views.shape
        and np.array_equal(one.field.view_x_m, other.field.view_x_m)
        and np.array_equal(one.field.view_y_m, other.field.view_y_m)
    )
