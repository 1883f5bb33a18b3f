"""Statistics of a recording, from its lines and from frames reconstructed again; its difference from another."""

import os
from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from app.bench.config import Bench
from app.errors import SETTINGS_CHANGED, InputError
from app.measurement.calibration import Calibration
from app.measurement.measurement import Measurement
from app.progress import Progress, counted
from app.recording.frame_lines import FrameLine
from app.recording.reader import Recording
from app.recording.reprocess import Change, reprocess
from app.results.frame_tallies import QualityTally
from app.results.replay import are_alike
from reconstruction.arrays import Floats
from reconstruction.displacement import Outcome
from reconstruction.geometry import Field
from reconstruction.refinement import mean_rms
from reconstruction.wavefront import Wavefront, rms, without_piston

_SAMPLED_FRAMES = 200  # evenly spaced frames that are reconstructed again


@dataclass(frozen=True, slots=True, eq=False)
class Statistics:
    """Statistics of the frames that have a wavefront."""

    frames: NDArray[np.int64]  # their indices in the recording, (frame,)
    mean: Floats  # wavefront, rad, (view_row, view_column, lenslet_row, lenslet_column); NaN where unknown
    sigma: Floats  # of one frame, rad, root mean square over views and frames, (lenslet_row, lenslet_column)
    lost: Floats  # share of the frames without a slope, (lenslet_row, lenslet_column)
    reason: NDArray[np.int8]  # most frequent `Outcome` of those, else CONVERGED, (lenslet_row, lenslet_column)
    rms_rad: Floats  # mean over the views, (frame,)
    rms_sigma_rad: Floats  # RMS of the wavefront's standard deviation, an upper bound for that of `rms_rad`, (frame,)
    wavefront: Wavefront  # of the middle frame
    refined: int  # number of refined frames
    quality: QualityTally


@dataclass(frozen=True, slots=True, eq=False)
class Summary:
    """A recording, or some of its frames."""

    recording: Recording
    lines: list[FrameLine]  # of the selected frames
    problems: Counter[str]  # why frames were not reconstructed live, or cannot be now, with their number
    sampled: int  # frames that were reconstructed again
    calibration: Calibration | None  # of the first frame that has one, after the change
    calibrations: int  # number of calibrations in the selected frames
    statistics: Statistics | None  # None if no frame has a wavefront

    @property
    def name(self) -> str:
        """Name of the recording's folder; bytes that are no text are shown as codes."""
        return os.fsencode(self.recording.folder.resolve().name).decode("utf-8", "backslashreplace")

    @property
    def bench(self) -> Bench:
        """Bench of the reconstruction."""
        return self.recording.bench if self.calibration is None else self.calibration.bench

    @property
    def sampled_frames(self) -> str:
        """Number of frames in the statistics, in words."""
        whole = counted(len(self.lines))
        count = 0 if self.statistics is None else len(self.statistics.frames)
        return whole if count == len(self.lines) else f"{count} of {whole}"


def summarise(recording: Recording, frames: str | None, progress: Progress, *, change: Change | None = None) -> Summary:
    """Summarise a recording from its lines and from at most 200 of the frames FIRST:END, reconstructed again."""
    chosen = recording.select(frames)
    lines = [recording.line(index) for index in chosen]
    numbers = [line.calibration for line in lines if line.calibration is not None]
    some = chosen[:: -(-len(chosen) // _SAMPLED_FRAMES)]
    again: Counter[str] = Counter()
    sums = _Sums()
    for done, frame in enumerate(reprocess(recording, some, change), 1):
        if frame.problem and not recording.line(frame.index).problem:
            again[frame.problem] += 1
        sums.take(frame, is_early=2 * done <= len(some) + 1)
        progress(f"reconstructing {recording.folder.name}", done / len(some))
    problems = Counter(line.problem for line in lines if line.problem)
    first = recording.calibration(numbers[0]) if numbers else None
    return Summary(
        recording=recording,
        lines=lines,
        problems=problems + again,
        sampled=len(some),
        calibration=first if first is None or change is None else change(first),
        calibrations=len(set(numbers)),
        statistics=sums.statistics(),
    )


class _Sums:
    """Sums over frames."""

    def __init__(self) -> None:
        self._frames: list[int] = []
        self._rms_rad: list[float] = []
        self._rms_sigma_rad: list[float] = []
        self._wavefront: Wavefront | None = None
        self._views = self._known = self._variance = self._variances = np.zeros(())
        self._outcomes = np.zeros((len(Outcome), 1, 1), np.int64)  # number of frames, (outcome, ...)
        self._refined = 0
        self._quality = QualityTally()

    def take(self, frame: Measurement, *, is_early: bool) -> None:
        """Add a frame; keep the last early wavefront, or the first if none is early."""
        wavefront = frame.wavefront
        if wavefront is None:
            return
        views, variance = wavefront.views, wavefront.sigma() ** 2
        if self._wavefront is not None and not are_alike(wavefront, self._wavefront):
            raise InputError(SETTINGS_CHANGED)
        if is_early or self._wavefront is None:
            self._wavefront = wavefront
        self._views, self._known = self._views + np.nan_to_num(views), self._known + np.isfinite(views)
        self._variance = self._variance + np.nansum(variance, axis=(0, 1))
        self._variances = self._variances + np.isfinite(variance).sum(axis=(0, 1))
        self._outcomes = self._outcomes + (wavefront.displacement.outcome == np.array(Outcome)[:, None, None])
        self._frames.append(frame.index)
        self._rms_rad.append(mean_rms(views))
        self._rms_sigma_rad.append(float(np.sqrt(np.nanmean(variance))) if np.isfinite(variance).any() else np.nan)
        self._refined += frame.assumed.refinement.bias is not None
        self._quality.take(frame.quality)

    def statistics(self) -> Statistics | None:
        """Statistics of all frames; None if none has a wavefront."""
        if self._wavefront is None:
            return None
        lost = self._outcomes.copy()
        lost[Outcome.CONVERGED] = 0
        with np.errstate(invalid="ignore"):  # unknown in all frames
            return Statistics(
                frames=np.array(self._frames),
                mean=self._views / self._known,
                sigma=np.sqrt(self._variance / self._variances),
                lost=lost.sum(axis=0) / len(self._frames),
                reason=np.argmax(lost, axis=0).astype(np.int8),
                rms_rad=np.array(self._rms_rad),
                rms_sigma_rad=np.array(self._rms_sigma_rad),
                wavefront=self._wavefront,
                refined=self._refined,
                quality=self._quality,
            )


@dataclass(frozen=True, slots=True, eq=False)
class Residual:
    """Mean wavefronts of two recordings and their difference, rad.

    All are (view_row, view_column, lenslet_row, lenslet_column).
    """

    name: str
    other_name: str
    field: Field
    mean: Floats
    other_mean: Floats
    views: Floats  # difference without piston, where both are known

    @property
    def rms_rad(self) -> Floats:
        """RMS of the difference at each view, (view_row, view_column)."""
        return rms(self.views)

    @property
    def sentence(self) -> str:
        """The three numbers of the paper's Table 2."""
        values = self.rms_rad
        return (
            f"RMS of the difference at the views: least {np.nanmin(values):.3f}, most {np.nanmax(values):.3f},"
            f" mean {np.nanmean(values):.3f} rad"
        )


def residual_of(summary: Summary, other: Summary) -> Residual:
    """Subtract the mean wavefronts of `other`; `InputError` if they cannot be subtracted."""
    one, two = summary.statistics, other.statistics
    for each in (summary, other):
        if each.statistics is None:
            raise InputError(f"{each.recording.folder}: no frame has a wavefront: there is nothing to compare")
    assert one is not None and two is not None  # noqa: S101, PT018 - checked above
    folder, other_folder = summary.recording.folder, other.recording.folder
    if not are_alike(one.wavefront, two.wavefront):
        raise InputError(f"{other_folder}: has other views or lenslets than {folder}: nothing to compare")
    views = without_piston(one.mean - two.mean)
    if not np.isfinite(views).any():
        raise InputError(f"{other_folder}: has no lenslet in common with {folder}")
    return Residual(summary.name, other.name, one.wavefront.field, one.mean, two.mean, views)
