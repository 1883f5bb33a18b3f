"""Rate and latency of the live path with and without window, for `svwfs benchmark --live`."""

from __future__ import annotations

import math
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, astuple, dataclass, replace
from operator import ge, le, lt
from pathlib import Path
from typing import Any, NamedTuple

from app.acquisition.remote.own_connection import OwnConnection
from app.acquisition.start_up import HeadlessRun, is_recorded
from app.bench.config import Bench, write_bench
from app.errors import InputError, RunError, ended_by
from app.evaluation import processor_time
from app.measurement.measurement import FrameTotals
from app.progress import Progress
from app.recording.recorder import RECENT_S, RecordingState
from app.run_facts import machine_facts, timing_facts, versions
from app.timing import StageTimes, TimedStage
from reconstruction.runtime.threads import name_threads
from reconstruction.settings import FIELD_MODES

LEAST_S, MOST_S = 1.0, 3600.0
_WITHOUT_WINDOW_S = 20.0  # at most
_MEMORY_S = 50.0  # at the end of the run, at most
_MOST_FIELD_MODES = max(FIELD_MODES.values())
_BLOCKS_BYTES = 4 * 4096  # overhead of a frame's folder, files and line
_MORE_FRAMES = 50  # equivalent of dark, reference and files written once
_MARGIN = 1.1  # times the expected size of the recording
_BARE_WARM_UP_S = 3.0  # at most
_LEAST_SHARE, _LEAST_SHARE_WITH_PANELS = 0.99, 0.97  # of the frames, reconstructed
_PROCESSOR_S, _PROCESSOR_LASTING_S = 55.0, 68.3  # asked of --live 40, and how long that runs


@dataclass(frozen=True, slots=True, kw_only=True)
class LivePlan:
    """A simulated bench, measured for some seconds after the warm-up."""

    bench: Bench
    seconds: float
    record_in: Path | None  # folder of the temporary recording; None for none
    with_panels: bool = False  # coefficients, history and histogram are open beside the window
    warm_up_s: float = RECENT_S + 2.0  # until the memory is full of recent frames
    is_probe: bool = False  # without the run that has neither window nor recording

    def __post_init__(self) -> None:
        if not LEAST_S <= self.seconds <= MOST_S:
            raise InputError(f"--live {self.seconds:g}: must be {LEAST_S:g} ... {MOST_S:g} seconds")
        if not self.bench.is_simulated:
            raise InputError(f"--live runs the simulated camera; this bench has {self.bench.camera.driver}")

    @property
    def without_window_s(self) -> float:
        """Duration of the run without window and recording."""
        return min(_WITHOUT_WINDOW_S, self.seconds / 3)

    @property
    def lasting_s(self) -> float:
        """Duration of both runs after their first wavefronts."""
        return self.warm_up_s + self.seconds + self.bare_warm_up_s + self.without_window_s

    @property
    def bare_warm_up_s(self) -> float:
        """Warm-up of the run without window and recording, which measures no memory."""
        return min(_BARE_WARM_UP_S, self.warm_up_s)

    @property
    def memory_s(self) -> float:
        """Duration at the end over which the memory must not grow."""
        return min(_MEMORY_S, self.seconds * 5 / 6)

    @property
    def recording_bytes(self) -> float:
        """Estimated maximum size of the recording."""
        camera, sensor = self.bench.camera_model, self.bench.sensor
        pixels = camera.rows * camera.columns * 2
        displacements = sensor.lenslet_rows * sensor.lenslet_columns * _MOST_FIELD_MODES * 2 * 8
        frames = (self.warm_up_s + self.seconds) / camera.exposure_s + _MORE_FRAMES
        return frames * (pixels + displacements + _BLOCKS_BYTES) * _MARGIN


@contextmanager
def recording_folder(plan: LivePlan, progress: Progress) -> Iterator[Path | None]:
    """Give a new folder for the recording and remove it at the end; None without a recording.

    `InputError` if the plan's folder is missing, not writable or too small.
    """
    where = plan.record_in
    if where is None:
        yield None
        return
    if not where.is_dir():
        raise InputError(f"{where}: no such folder")
    free, needed = shutil.disk_usage(where).free, plan.recording_bytes
    if free < needed:
        raise InputError(
            f"{where}: the recording takes up to {needed / 1e9:.1f} GB, and {free / 1e9:.1f} GB are free:"
            " name a folder on another disk with --record-in, or give --no-record"
        )
    try:
        folder = Path(tempfile.mkdtemp(prefix="svwfs-benchmark-", dir=where))
    except OSError as error:
        raise InputError(f"{where}: not writable: {error.strerror or error}") from error
    try:
        yield folder / "recording"
    finally:
        with ended_by(lambda *_: None):  # a second Ctrl-C must not interrupt the removal
            progress("removing the recording", 1.0)
            shutil.rmtree(folder)


def share(frames: FrameTotals) -> float:
    """Share of reconstructed frames among all frames of the camera, lost ones included."""
    taken = frames.acquired + frames.lost
    return frames.reconstructed / taken if taken else math.nan


_GIVE_UP_S = 600.0  # for rendering the bench and compiling
_PAUSES: dict[str, TimedStage] = {"acquisition": "to_result", "recorder": "record", "window": "draw"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Span:
    """Measurements after the warm-up."""

    first_wavefront_s: float  # since its process was started, with opening and calibrating the devices
    seconds: float
    frames: FrameTotals
    times: dict[TimedStage, StageTimes]  # counts are of the span, statistics of the times that were kept at its end
    memory_mb: tuple[
        dict[str, float], dict[str, float]
    ]  # by process, at begin and end of its last seconds; {}: unknown
    processor_s: dict[str, dict[str, float]]  # of each thread by process; "" is all of one; empty if unknown

    @property
    def rate_hz(self) -> float:
        """Wavefronts a second."""
        return self.frames.reconstructed / self.seconds

    @property
    def redrawn_hz(self) -> float:
        """Rate at which a window showed something new."""
        return self.times["draw"].count / self.seconds

    @property
    def redraw_s(self) -> float | None:
        """Processor time of the window's process for each redraw; None if unknown."""
        window, redraws = self.processor_s.get(processor_time.WINDOW), self.times["draw"].count
        return window[""] / redraws if window and redraws else None

    @property
    def total_mb(self) -> tuple[float, float]:
        """Memory of all processes but the simulated rendering, at begin and end of the last seconds."""
        begin, end = (sum(each.values()) - each.get(processor_time.RENDERING, 0.0) for each in self.memory_mb)
        return begin, end

    @property
    def camera_s(self) -> float:
        """Processor time of the simulated camera: detector and rendering."""
        rendering = self.processor_s.get(processor_time.RENDERING, {})
        detectors = (
            seconds
            for threads in self.processor_s.values()
            for name, seconds in threads.items()
            if name.startswith(processor_time.DETECTOR)
        )
        return rendering.get("", 0.0) + sum(detectors)

    def pauses(self) -> Iterator[str]:
        """Yield the longest pauses of acquisition, recorder and window with what ran meanwhile."""
        for who, stage in _PAUSES.items():
            if (found := self.times[stage]).count:
                during = f", during {found.cause}" if found.cause else ""
                yield f"{who}: {stage.replace('_', ' ')} {1e3 * found.max_s:.0f} ms{during}"

    def tree(self) -> dict[str, Any]:
        """Return everything for JSON."""
        rates = {"rate_hz": self.rate_hz, "redrawn_hz": self.redrawn_hz}
        return {**asdict(self), **rates, "share": _known(share(self.frames)), "times": timing_facts(self.times)}


class MeasuredRun(HeadlessRun):
    """One run of an instrument in a process of its own, which the caller closes."""

    def __init__(
        self,
        acquisition: OwnConnection,
        progress: Progress,
        *,
        warm_up_s: float,
        seconds: float,
        memory_s: float = 0.0,
        record_into: Path | None = None,
    ) -> None:
        """Prepare a span of `seconds` after the warm-up; the memory is measured over its last `memory_s`."""
        super().__init__(acquisition, progress)
        self._record_into = record_into
        self._warm_up_s, self._seconds, self._memory_s = warm_up_s, seconds, memory_s
        self._span: Span | None = None
        self._made_s = time.perf_counter()

    @property
    def span(self) -> Span:
        """The measured span."""
        if self._span is None:
            raise RunError("the run ended before all was measured")
        return self._span

    def steps(self) -> Iterator[None]:
        """Make the steps that are due, some times a second; `RunError` or `InputError` if one fails."""
        acquisition, folder = self.acquisition, self._record_into
        first_s = yield from self.first_wavefront(_GIVE_UP_S)
        acquisition.timings.forget_longest()  # of this process; those of the instrument begin with the recording
        if folder is not None:
            self.send(lambda to: (to.start_recording(folder, command="benchmark"),))

        def wait(until_s: float, text: str) -> Iterator[None]:
            whole_s = self._warm_up_s + self._seconds
            return self.until(
                lambda: time.perf_counter() >= until_s,
                text=text,
                fraction=lambda: min(1.0, (time.perf_counter() - first_s) / whole_s),
            )

        yield from wait(first_s + self._warm_up_s, "warming up")
        name_threads()
        names = processor_time.processes()
        stages = yield from self.stage_times()
        began_s, before = time.perf_counter(), acquisition.counts
        taken_s = processor_time.processor_times(names)
        end_s = began_s + self._seconds
        yield from wait(end_s - self._memory_s, "measuring")
        memory_mb = processor_time.memory_mb(names)
        yield from wait(end_s, "measuring")
        ended_s, after = time.perf_counter(), acquisition.counts
        times = yield from self.stage_times()
        processor_s: dict[str, dict[str, float]] = {name: {} for name in names.values()}
        for (pid, thread), seconds in processor_time.processor_times(names).items():
            of = processor_s[names[pid]]
            of[thread] = of.get(thread, 0.0) + max(seconds - taken_s.get((pid, thread), 0.0), 0.0)
        self._span = Span(
            first_wavefront_s=first_s - self._made_s,
            seconds=ended_s - began_s,
            frames=FrameTotals(*(now - then for now, then in zip(astuple(after), astuple(before), strict=True))),
            times={stage: replace(each, count=each.count - stages[stage].count) for stage, each in times.items()},
            memory_mb=(memory_mb, processor_time.memory_mb(names)),
            processor_s=processor_s,
        )
        if folder is not None:
            self.send(lambda to: (to.stop_recording(),))
            yield from self.until(lambda: is_recorded(acquisition), text="measuring", fraction=lambda: 1.0)


class Limit(NamedTuple):
    """A figure and the limit that `--check` asks for; an unknown figure misses it."""

    name: str  # in JSON
    value: float
    holds: Callable[[float, float], bool]
    limit: float
    asked: str  # the limit in words

    @property
    def is_met(self) -> bool:
        """True if the figure keeps the limit."""
        return self.holds(self.value, self.limit)


@dataclass(frozen=True, slots=True, kw_only=True)
class LiveFigures:
    """Figures of the run with a window and an optional recording, and of the run without."""

    plan: LivePlan
    is_seen: bool  # the window was on a display
    window: Span
    recording: RecordingState | None  # at its end
    bare: Span | None = None  # without window and recording
    processor_s: float | None = None  # of both runs and all their processes, from start to end; None if unknown

    @property
    def keeps_up(self) -> bool:
        """True if 99 % of the frames were reconstructed, none lost and all recorded."""
        frames, is_recorded = self.window.frames, not (self.recording and self.recording.problem)
        return share(frames) >= _LEAST_SHARE and not frames.lost and is_recorded

    @property
    def rate_ratio(self) -> float:
        """Rate with the window over the rate without; NaN without any wavefront."""
        return self.window.rate_hz / self.bare.rate_hz if self.bare and self.bare.rate_hz else math.nan

    @property
    def memory_growth(self) -> float | None:
        """Relative growth of the memory; None if the system does not report it."""
        begin_mb, end_mb = self.window.total_mb
        return end_mb / begin_mb - 1 if begin_mb else None

    def lines(self) -> list[tuple[str, str, Limit | None]]:
        """Return name, measured value and limit of every line of the table."""
        window, bare, recording, growth = self.window, self.bare, self.recording, self.memory_growth
        frames, times, first_s, ratio = window.frames, window.times, window.first_wavefront_s, self.rate_ratio
        lines: list[tuple[str, str, Limit | None]] = []

        def add(name: str, measured: str, *limit: Any) -> None:
            lines.append((name, measured, Limit(*limit) if limit else None))

        def add_times(name: str, stage: TimedStage, *limit: Any) -> None:
            each = times[stage]
            shown = " / ".join(f"{1e3 * seconds:.1f}" for seconds in (each.p50_s, each.p99_s, each.max_s))
            add(name, f"{shown} ms" if each.count else "none", *limit)

        add("frames acquired", f"{frames.acquired}")
        least = _LEAST_SHARE_WITH_PANELS if self.plan.with_panels else _LEAST_SHARE
        reconstructed = f"{frames.reconstructed}: {100 * share(frames):.2f} %"
        add("reconstructed", reconstructed, "share", share(frames), ge, least, f">= {100 * least:.0f} %")
        add("lost by the camera", f"{frames.lost}", "lost", frames.lost, le, 0, "none")
        late_s, longest = times["to_result"].p99_s, "all < 100 ms"
        add_times("camera to result", "to_result", "to_result_p99_s", late_s, le, 0.030, "99 % <= 30 ms")
        add_times("camera to screen", "to_screen")
        redrawn_hz = window.redrawn_hz
        add("window redrawn", f"{redrawn_hz:.1f} /s", "redrawn_hz", redrawn_hz, ge, 20.0, ">= 20 /s")
        add_times("redraw", "draw", "draw_max_s", times["draw"].max_s, lt, 0.1, longest)
        if (redraw_s := window.redraw_s) is not None:
            add("processor, each redraw", f"{1e3 * redraw_s:.1f} ms", "redraw_s", redraw_s, le, 0.012, "<= 12 ms")
        if recording is not None:
            add_times("frame written to the disk", "record", "record_max_s", times["record"].max_s, lt, 0.1, longest)
            problem, recorded = bool(recording.problem), f"{recording.frames}"
            add("recorded, with warm-up", recorded, "recording_problems", problem, le, 0, "all frames")
        memory = f"memory, last {self.plan.memory_s:.0f} s"
        if growth is None:
            add(memory, "unknown on this system")
        else:
            begin_mb, end_mb = window.total_mb
            add("memory of all processes", f"{end_mb:.0f} MB", "memory_mb", end_mb, le, 1000.0, "<= 1000 MB")
            grown = f"{begin_mb:.0f} > {end_mb:.0f} MB, {100 * growth:+.2f} %"
            add(memory, grown, "memory_growth", growth, lt, 0.01, "< 1 %")
        if bare is not None:
            add(f"rate without window, {bare.seconds:.0f} s", f"{bare.rate_hz:.2f} /s")
            rate = f"{window.rate_hz:.2f} /s: {100 * ratio:.1f} %"
            add("rate with it", rate, "rate_ratio", ratio, ge, 0.95, ">= 95 %")
        add("first wavefront after", f"{first_s:.1f} s", "first_wavefront_s", first_s, le, 5.0, "<= 5 s, warm")
        if (taken_s := self.processor_s) is not None:
            most_s = _PROCESSOR_S * (self.plan.lasting_s / _PROCESSOR_LASTING_S)
            add(
                "processor, all processes", f"{taken_s:.1f} s", "processor_s", taken_s, le, most_s, f"<= {most_s:.0f} s"
            )
        return lines

    def limits(self) -> list[Limit]:
        """Return all figures that have a limit."""
        return [limit for *_, limit in self.lines() if limit is not None]

    def missed(self) -> list[str]:
        """Return a sentence for every figure that misses its limit."""
        return [f"{each.name} is {each.value:.3g}, asked {each.asked}" for each in self.limits() if not each.is_met]

    def tree(self) -> dict[str, Any]:
        """Return everything for JSON, with computer and libraries."""
        plan, recording = self.plan, self.recording
        live = {
            "seconds": plan.seconds,
            "warm_up_s": plan.warm_up_s,
            "window_is_seen": self.is_seen,
            "bench": write_bench(plan.bench),
            "window": self.window.tree(),
            "without_window": self.bare and self.bare.tree(),
            "memory_s": plan.memory_s,
            "processor_s": self.processor_s,
            "recording": None if recording is None else {"frames": recording.frames, "problem": recording.problem},
            "limits": {
                each.name: {"value": _known(each.value), "limit": each.limit, "is_met": each.is_met}
                for each in self.limits()
            },
        }
        return {"live": live, "machine": machine_facts(), "versions": versions()}


def _known(value: float) -> float | None:
    """JSON has no NaN."""
    return None if math.isnan(value) else value
