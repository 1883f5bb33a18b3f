"""Summary of a recording: statistics, facts, and the difference from another."""

import math
import os
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.bench.config import Bench
from app.errors import SETTINGS_CHANGED, InputError
from app.measurement.averages import Average
from app.measurement.calibration import Calibration
from app.measurement.measurement import Measurement
from app.progress import Progress, counted, counting
from app.recording.frame_lines import FrameLine
from app.recording.reader import Recording
from app.recording.reprocess import Change, reprocess
from app.results.replay import are_alike
from app.results.run_summary import QualityTally
from reconstruction.arrays import Floats
from reconstruction.displacement import LensletStatus
from reconstruction.wavefront import Wavefront, mean_known, mean_rms

_SAMPLED_FRAMES = 200  # evenly spaced frames that are reconstructed again


@dataclass(frozen=True, slots=True, eq=False)
class Statistics:
    """Statistics of the frames that have a wavefront."""

    frames: NDArray[np.int64]  # their indices in the recording, (frame,)
    mean: Floats  # wavefront, rad, (view_row, view_column, lenslet_row, lenslet_column); NaN where unknown
    sigma: Floats  # of one frame, rad, root mean square over views and frames, (lenslet_row, lenslet_column)
    lost: Floats  # share of the frames without a slope, (lenslet_row, lenslet_column); NaN where absent
    reason: NDArray[np.int8]  # most frequent `LensletStatus` of those, else CONVERGED, (lenslet_row, lenslet_column)
    rms_rad: Floats  # mean over the views, (frame,)
    rms_sigma_rad: Floats  # RMS of the wavefront's standard deviation, an upper bound for that of `rms_rad`, (frame,)
    wavefront: Wavefront  # of the middle frame
    middle: int  # index of that frame in the recording
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
    """Summarise a recording from its lines and at most 200 of its frames, reconstructed again."""
    chosen = recording.select(frames)
    lines = [recording.line(index) for index in chosen]
    numbers = [line.calibration for line in lines if line.calibration is not None]
    some = chosen[:: -(-len(chosen) // _SAMPLED_FRAMES)]
    problems = Counter(line.problem for line in lines if line.problem)

    def again() -> Iterator[Measurement]:
        frames = reprocess(recording, some, change)
        for frame in counting(frames, len(some), progress, f"reconstructing {recording.folder.name}"):
            if frame.problem and not recording.line(frame.index).problem:
                problems[frame.problem] += 1
            yield frame

    statistics = _statistics(again(), (len(some) + 1) // 2)
    first = recording.calibration(numbers[0]) if numbers else None
    return Summary(
        recording=recording,
        lines=lines,
        problems=problems,
        sampled=len(some),
        calibration=first if first is None or change is None else change(first),
        calibrations=len(set(numbers)),
        statistics=statistics,
    )


def _statistics(frames: Iterable[Measurement], early: int) -> Statistics | None:
    """Take the statistics of frames; `wavefront` is the last of the first `early` ones, or the first."""
    indices, rms_rad, rms_sigma_rad = list[int](), list[float](), list[float]()
    middle: tuple[int, Wavefront] | None = None
    total = known = variances = known_variances = np.zeros(())
    outcomes = np.zeros((len(LensletStatus), 1, 1), np.int64)  # number of frames, (outcome, ...)
    refined, quality = 0, QualityTally()
    for done, frame in enumerate(frames, 1):
        if (wavefront := frame.wavefront) is None:
            continue
        views, variance = wavefront.views, wavefront.sigma() ** 2
        if middle is not None and not are_alike(wavefront, middle[1]):
            raise InputError(SETTINGS_CHANGED)
        if middle is None or done <= early:
            middle = frame.index, wavefront
        total, known = total + np.nan_to_num(views), known + np.isfinite(views)
        variances = variances + np.nansum(variance, axis=(0, 1))
        known_variances = known_variances + np.isfinite(variance).sum(axis=(0, 1))
        outcomes = outcomes + (wavefront.displacement.outcome == np.array(LensletStatus)[:, None, None])
        indices.append(frame.index)
        rms_rad.append(mean_rms(views))
        rms_sigma_rad.append(float(np.sqrt(mean_known(variance, axis=None))))
        refined += frame.assumed.refinement.bias is not None
        quality.take(frame.quality)
    if middle is None:
        return None
    absent = outcomes[LensletStatus.ABSENT] > 0
    outcomes[[LensletStatus.CONVERGED, LensletStatus.ABSENT]] = 0
    with np.errstate(invalid="ignore"):  # unknown in all frames
        return Statistics(
            frames=np.array(indices),
            mean=total / known,
            sigma=np.sqrt(variances / known_variances),
            lost=np.where(absent, np.nan, outcomes.sum(axis=0) / len(indices)),
            reason=np.argmax(outcomes, axis=0).astype(np.int8),
            rms_rad=np.array(rms_rad),
            rms_sigma_rad=np.array(rms_sigma_rad),
            wavefront=middle[1],
            middle=middle[0],
            refined=refined,
            quality=quality,
        )


Fact = tuple[str, str]  # label and text
_MOST_DOUBTS = 4


def facts(summary: Summary) -> list[Fact]:
    """Return the facts of a recording, without those that it does not contain."""
    run, lines, bench = summary.recording.run, summary.lines, summary.bench
    camera, light, stage = (_section(run, "devices", name) for name in ("camera", "light", "stage"))
    doubts = [] if summary.statistics is None else summary.statistics.quality.sentences
    rows, columns = summary.recording.pixels(lines[0].index).shape
    size = f"{columns} x {rows} pixels of {bench.sensor.pixel_pitch_m * 1e6:g} µm"
    temperatures = [f"{name} {value}" for name, value in camera.items() if "temperature" in name.lower()]
    exposure = (
        f"{_range((line.exposure_s for line in lines), 1e3)} ms",
        f"{camera['amplifier']} amplifier" if "amplifier" in camera else "",
        f"readout speed {camera['readout_speed']}" if "readout_speed" in camera else "",
        f"em gain {_range(line.em_gain for line in lines)}",
    )
    current = _range((line.light_current_a for line in lines if line.light_current_a is not None), 1e3)
    is_partly_off = any(line.is_light_on is False for line in lines)
    shining = (str(light.get("name", "")), f"{current} mA" if current else "", "partly off" * is_partly_off)
    said = [
        ("recorded", _when(summary)),
        ("frames", _counts(summary)),
        *[("", f"{count} of them: {problem}") for problem, count in summary.problems.most_common(2)],
        *[("doubtful", sentence) for sentence in doubts[:_MOST_DOUBTS]],
        ("camera", ", ".join([str(camera.get("name", bench.camera.driver)), size, *temperatures[:1]])),
        ("exposure", ", ".join(filter(None, exposure))),
        ("light", ", ".join(filter(None, shining))),
        ("mask", str(stage.get("mask", bench.simulation.source.mask))),
        *_of_calibration(summary),
        ("method", _method(bench, summary)),
        ("software", _software(run)),
    ]
    return [(name, text) for name, text in said if text]


def _section(tree: dict[str, Any], *names: str) -> dict[str, Any]:
    """Return a section of `run.json`, empty if it is missing or damaged."""
    for name in names:
        tree = tree.get(name, {})
        if not isinstance(tree, dict):
            return {}
    return tree


def _when(summary: Summary) -> str:
    recording = summary.recording
    parts = []
    with suppress(KeyError, ValueError):  # missing, or damaged
        began = datetime.fromisoformat(str(recording.run["began"]))
        parts.append(f"{began:%Y-%m-%d %H:%M:%S} {began.tzname() or ''}".strip())
    parts.append(f"{summary.lines[-1].host_time_s - summary.lines[0].host_time_s:.1f} s from first to last frame")
    if command := recording.run.get("command"):
        parts.append(f"by svwfs {command}")
    if not recording.is_complete:
        parts.append("not finished: it grows, or svwfs recover finishes it")
    if note := recording.run.get("note"):
        parts.append(f"note: {note}")
    if recording.ended_early:
        parts.append(f"ended early: {recording.ended_early}")
    return "; ".join(parts)


def _counts(summary: Summary) -> str:
    lines, whole = summary.lines, len(summary.recording)
    acquired = _section(summary.recording.run, "frames").get("acquired")
    some = "" if len(lines) == whole else f"{lines[0].index} ... {lines[-1].index} of "
    gap_s = sum(line.gap_s for line in lines)
    with_wavefront = 0 if summary.statistics is None else len(summary.statistics.frames)
    return (
        f"{some}{whole} recorded{'' if acquired is None else f' of {acquired} acquired'};"
        f" {sum(line.lost for line in lines)} lost by the camera;"
        f"{f' it stood for {gap_s:.1f} s;' if gap_s else ''}"
        f" {with_wavefront} of {summary.sampled} reconstructed again have a wavefront"
    )


def _of_calibration(summary: Summary) -> Iterator[Fact]:
    calibration = summary.calibration
    if calibration is None:
        yield "reference", "none: these frames have no calibration"
        return
    several = f"; the first of {summary.calibrations} calibrations" * (summary.calibrations > 1)
    yield "dark", "none" if calibration.dark is None else _average(calibration.dark)
    yield "reference", _average(calibration.reference) + several
    noise = calibration.noise.of_frame
    yield (
        "noise",
        "unknown from dark and reference; error bars from the misfit"
        if noise is None
        else f"{noise.counts_per_electron:.3g} counts per electron, read noise {noise.read_noise_counts:.3g} counts,"
        " from dark and reference",
    )
    if calibration.bench.linearity is not None:
        yield "linearity", f"corrected: {calibration.bench.linearity.sentence}"
    sensor, lattice = calibration.bench.sensor, calibration.lattice
    lies = f"centre ({lattice.center_x_px:.2f}, {lattice.center_y_px:.2f}) px"
    lies += f", turned by {lattice.rotation_rad * 1e3:+.2f} mrad"
    lenslets = "{1} x {0} lenslets".format(*sensor.lenslets)
    yield "lattice", f"{lenslets}, pitch {lattice.pitch_text(4)}, {lies}"


def _average(average: Average) -> str:
    gain = f", em gain {average.em_gain:g}" * (average.em_gain != 1)
    return f"mean of {counted(average.frames)} of {average.exposure_s * 1e3:g} ms{gain}"


def _method(bench: Bench, summary: Summary) -> str:
    registration, reconstruction = bench.registration, bench.reconstruction
    parts: list[str] = [registration.named_method]
    if registration.fits_warps:
        parts.append(f"warp {registration.warp or 'automatic'}")
    parts.append(reconstruction.method)
    if reconstruction.method == "modal":
        modes = reconstruction.pupil_modes
        parts.append(f"{reconstruction.basis}, {modes or 'automatic number of'} pupil modes")
    if summary.statistics is not None and summary.statistics.refined:
        parts.append(f"refined {summary.statistics.refined} of {len(summary.statistics.frames)}")
    return ", ".join(parts)


def _software(run: dict[str, Any]) -> str:
    versions, machine = _section(run, "versions"), _section(run, "machine")
    parts = [f"{name} {versions[name]}" for name in ("svwfs", "python", "numpy") if name in versions]
    if "system" in machine:
        parts.append(f"{machine['system']}, {machine.get('cores', '?')} cores")
    return ", ".join(parts)


def _range(values: Iterable[float], factor: float = 1.0) -> str:
    """The value, or the smallest and the largest; empty without any."""
    known = [value * factor for value in values]
    if not known:
        return ""
    least, most = min(known), max(known)
    return f"{least:.4g}" if math.isclose(least, most, rel_tol=1e-6) else f"{least:.4g} ... {most:.4g}"
