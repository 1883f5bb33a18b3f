"""Recordings reconstructed again: compared with what was recorded, or with another bench."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib.metadata import version
from operator import itemgetter
from pathlib import Path

import numpy as np

from app.bench.config import Bench, parse_bench, write_bench
from app.errors import InputError, RunError
from app.measurement.calibration import Calibration
from app.measurement.measurement import SKIPPED, Measurement
from app.progress import Progress, counted
from app.recording.folder import version_of
from app.recording.frame_lines import FrameLine
from app.recording.reader import Recording
from app.recording.reprocess import Change, reprocess
from app.results.dataset import results_in_pieces
from app.results.result_file import VIEW, Variable, about, write_pieces
from app.results.run_summary import FrameTally
from app.run_facts import machine_facts
from reconstruction.errors import ReconstructionError
from reconstruction.geometry import Field
from reconstruction.runtime.threads import one_blas_thread
from reconstruction.solve.modal import ModalSolution
from reconstruction.wavefront import Wavefront, mean_rms, rms

TOLERANCE_SIGMA = 1e-3  # of a frame that starts where it did live
START_TOLERANCE_SIGMA = (
    0.5  # of a frame that started from one before the recording: a fit ends where its steps are small
)

_LEAST_SIGMA = 1e-6  # of the largest: of a number that the solution fixes


class Verification:
    """Compares frames with what was recorded, in units of the standard deviation sigma of each number."""

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self._first = ""  # difference beyond the tolerance
        self.largest = {True: (0.0, -1), False: (0.0, -1)}  # sigma, and the frame; by whether its start is recorded
        self.frames = 0  # frames that were reconstructed, or refused, live
        self._skipped = 0
        self.different = 0

    def take(self, frame: Measurement) -> None:
        """Compare one frame, unless it was skipped live."""
        line = self._recording.line(frame.index)
        if line.calibration is None or line.problem == SKIPPED:
            self._skipped += 1
            return
        self.frames += 1
        problem, apart_sigma = _difference(self._recording, line, frame)
        has_start = self._recording.start(frame.index) is not None
        self.largest[has_start] = max(self.largest[has_start], (apart_sigma, frame.index), key=itemgetter(0))
        limit_sigma = TOLERANCE_SIGMA if has_start else START_TOLERANCE_SIGMA
        if problem or apart_sigma > limit_sigma:
            self.different += 1
            self._first = self._first or f"frame {frame.index}: {problem or f'by {apart_sigma:.2g} sigma'}"

    @property
    def passes(self) -> bool:
        """True if there was something to compare, and nothing differs."""
        return self.frames > 0 and not self.different

    @property
    def sentence(self) -> str:
        """The result in words."""
        if not self.frames:
            return "none of these frames was reconstructed when it was recorded: there is nothing to compare"
        (apart_sigma, index), (first_sigma, first) = self.largest[True], self.largest[False]
        largest = f"largest difference {apart_sigma:.2g} sigma, in frame {index}" if apart_sigma else "no difference"
        if first_sigma:
            largest += f", and {first_sigma:.2g} sigma in frame {first}, whose start was not recorded"
        if not self.different:
            skipped = f"; {self._skipped} more were not reconstructed then" if self._skipped else ""
            return f"{counted(self.frames)} as recorded: {largest}{skipped}"
        run = self._recording.run
        then, now = version_of(run) or "an unknown version", version("svwfs")
        software = f"recorded by svwfs {then}, replayed by {now}" if then != now else f"both by svwfs {now}"
        software += ", on another computer" * (run.get("machine") != machine_facts())
        return (
            f"{self.different} of {self.frames} frames differ from what was recorded; {self._first}; {largest}"
            f" ({software})"
        )


def _difference(recording: Recording, line: FrameLine, frame: Measurement) -> tuple[str, float]:
    """Say what cannot be compared with the recorded frame; return the largest difference of the rest, sigma."""
    wavefront, registered = frame.wavefront, frame.registered
    if line.problem != frame.problem:
        return f'the problem was "{line.problem}" and is "{frame.problem}"', 0.0
    if wavefront is None or registered is None:
        return "", 0.0
    sigma = np.sqrt(registered.variance)
    compared = {"displacements": (recording.displacement(line.index), registered.coefficients, sigma)}
    solution = wavefront.solution
    if isinstance(solution, ModalSolution):
        then = recording.coefficients(line.index)
        compared["coefficients"] = then, solution.coefficients, solution.coefficients_sigma
    rms_sigma = np.sqrt(np.nanmean(wavefront.sigma() ** 2))
    compared["the RMS"] = np.array(line.rms_rad, np.float64), np.array(mean_rms(wavefront.views)), rms_sigma
    largest_sigma = 0.0
    for what, (then, now, sigma) in compared.items():
        if then is None:
            return f"{what} are damaged or missing in the recording", largest_sigma
        if then.shape != now.shape or not np.array_equal(np.isnan(then), np.isnan(now)):
            return f"{what} of other lenslets or modes are known", largest_sigma
        apart = np.abs(then - now)
        least = _LEAST_SIGMA * np.max(sigma, initial=0, where=np.isfinite(sigma))  # the piston has none
        apart_sigma = apart / np.maximum(np.broadcast_to(sigma, apart.shape), least)
        largest_sigma = max(largest_sigma, float(np.max(apart_sigma, initial=0, where=apart > 0)))
    return "", largest_sigma


class Comparison:
    """RMS with the recorded bench, another, and of their difference; means (3, view_row, view_column), rad."""

    def __init__(self) -> None:
        self.frames = 0
        self.field: Field | None = None
        self.means_rad = np.zeros((3, 1, 1))

    def take(self, then: Measurement, now: Measurement) -> dict[str, Variable]:
        """Add a frame; return additional variables for its results."""
        if then.wavefront is None or now.wavefront is None or not are_alike(then.wavefront, now.wavefront):
            return {}
        self.frames, self.field = self.frames + 1, now.wavefront.field
        recorded, again = rms(then.wavefront.views), rms(now.wavefront.views)
        difference = rms(now.wavefront.views - then.wavefront.views)
        self.means_rad = self.means_rad + (np.stack([recorded, again, difference]) - self.means_rad) / self.frames
        return {
            "recorded_rms": (VIEW, recorded, about("rad", "RMS of each view's wavefront with the recorded bench")),
            "difference_rms": (VIEW, difference, about("rad", "RMS difference of each view's wavefront from it")),
        }


def are_alike(one: Wavefront, other: Wavefront) -> bool:
    """True if views and lenslets are the same, so that the wavefronts can be subtracted."""
    return (
        one.views.shape == other.views.shape
        and np.array_equal(one.field.view_x_m, other.field.view_x_m)
        and np.array_equal(one.field.view_y_m, other.field.view_y_m)
    )


@dataclass(slots=True, kw_only=True)
class Replay(FrameTally):
    """Outcome of a replay: a verification with the recorded bench, a comparison with another."""

    verification: Verification | None
    comparison: Comparison | None
    unrefined: int = 0  # frames refined live but not in this replay


def replay(
    folder: Path, change: Change | None, *, frames: str | None, out: Path | None, must_match: bool, progress: Progress
) -> Replay:
    """Reconstruct the recorded frames FIRST:END again and write the results to `out`, if given.

    With a `change` of the bench, see `change_of`, both are made and compared. With `must_match`, raise `RunError` if a
    result differs from the recorded one beyond the tolerance.
    """
    recording = Recording(folder)
    chosen = recording.select(frames)
    if must_match and change is not None:
        raise InputError("--verify compares with the recorded bench: leave --bench and --set out")
    comparison = Comparison() if change is not None else None
    made = Replay(verification=Verification(recording) if change is None else None, comparison=comparison)
    with one_blas_thread():
        stream = _frames(recording, chosen, change, made, progress)
        if out is not None:
            used, inputs = first_bench(recording, chosen, change), {"recording": recording.folder.name}
            write_pieces(out, results_in_pieces(stream), bench=used, inputs=inputs)
        for _ in stream:
            pass
    if must_match and made.verification is not None and not made.verification.passes:
        raise RunError(f"{folder}: {made.verification.sentence}")
    return made


def _frames(
    recording: Recording, chosen: range, change: Change | None, made: Replay, progress: Progress
) -> Iterator[tuple[Measurement, Mapping[str, Variable]]]:
    """Reconstruct each frame, with both benches if there are two; yield it with additional variables."""
    originals = reprocess(recording, chosen)
    others = originals if change is None else reprocess(recording, chosen, change)
    for done, frame in enumerate(others, 1):
        more: dict[str, Variable] = {}
        if made.verification is not None:
            made.verification.take(frame)
        if made.comparison is not None:
            more = made.comparison.take(next(originals), frame)
        made.count(frame)
        was_refined = recording.line(frame.index).bias is not None
        made.unrefined += frame.wavefront is not None and was_refined and frame.assumed.refinement.bias is None
        progress(f"replaying {counted(len(chosen))}", done / len(chosen))
        yield frame, more


def change_of(bench: Bench | None, settings: tuple[str, ...]) -> Change | None:
    """Return the change of a recorded calibration to another bench or other settings; None without any."""
    if bench is None and not settings:
        return None

    def change(calibration: Calibration) -> Calibration:
        other = bench or changed_bench(calibration.bench, settings)
        try:
            full_scale = calibration.full_scale
            return Calibration.of(other, calibration.reference, dark=calibration.dark, full_scale=full_scale)
        except ReconstructionError as error:
            raise InputError(f"the recorded reference does not fit this bench: {error}") from error

    return change


def changed_bench(recorded: Bench, settings: tuple[str, ...]) -> Bench:
    """Return a recorded bench with other settings; `InputError` if they are impossible."""
    return parse_bench(write_bench(recorded), "the recorded bench", settings)


def first_bench(recording: Recording, chosen: range, change: Change | None = None) -> Bench:
    """Return the bench of the first chosen frame that has one, after the change."""
    number = recording.first_calibration(chosen)
    if number is None:
        return recording.bench
    calibration = recording.calibration(number)
    return (calibration if change is None else change(calibration)).bench
