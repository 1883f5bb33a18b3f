"""Rate and latency of the live path with and without window, for `svwfs benchmark --live`."""

from __future__ import annotations

import math
import shutil
import tempfile
import time
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from dataclasses import asdict, astuple, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from app.acquisition.start_up import HeadlessRun, is_recorded
from app.bench.config import Bench, write_bench
from app.errors import InputError, ended_by
from app.evaluation import processor_time
from app.files import check_writable
from app.measurement.measurement import FrameTotals
from app.progress import Progress
from app.recording.recorder import RECENT_S, RecordingState
from app.run_facts import machine_facts, timing_facts, versions
from app.timing import StageTimes, TimedStage

LEAST_S, MOST_S = 1.0, 3600.0
_GIVE_UP_S = 600.0  # for rendering the bench and compiling
_WITHOUT_WINDOW_S = 20.0  # at most
_MEMORY_S = 50.0  # at the end of the run, at most
_MORE_FRAMES = 50  # equivalent of dark, reference and files written once
_MARGIN = 1.25  # of a recording over its pixels, which leaves space for displacements
_BARE_WARM_UP_S = 3.0  # at most
_LEAST_SHARE, _LEAST_SHARE_WITH_PANELS = 0.99, 0.97  # of the frames, reconstructed
_AT_LEAST = {"share", "redrawn_hz", "rate_ratio"}  # figures with a lower limit; the others have an upper one
_UNITS = {"": (1, ".0f"), "%": (100, ".2f"), "ms": (1e3, ".1f"), "s": (1, ".1f"), "/s": (1, ".1f"), "MB": (1, ".0f")}
_PROCESSOR_S, _PROCESSOR_LASTING_S = 55.0, 68.3  # asked of --live 40, and how long that runs


@dataclass(frozen=True, slots=True, kw_only=True)
class LivePlan:
    """A simulated bench, measured for some seconds after the warm-up."""

    bench: Bench
    seconds: float
    record_in: Path | None  # folder of the temporary recording; None for none
    with_panels: bool = False  # coefficients, history and histogram are open in addition to the window
    warm_up_s: float = RECENT_S + 2.0  # until the memory is full of recent frames

    def __post_init__(self) -> None:
        if not LEAST_S <= self.seconds <= MOST_S:
            raise InputError(f"--live {self.seconds:g}: must be {LEAST_S:g} ... {MOST_S:g} seconds")
        if not self.bench.is_simulated:
            raise InputError(f"--live runs the simulated camera; this bench has {self.bench.camera.driver}")

    @property
    def bare_s(self) -> tuple[float, float]:
        """Warm-up and duration of the run without window and recording."""
        return min(_BARE_WARM_UP_S, self.warm_up_s), min(_WITHOUT_WINDOW_S, self.seconds / 3)

    @property
    def lasting_s(self) -> float:
        """Duration of both runs after their first wavefronts."""
        return self.warm_up_s + self.seconds + sum(self.bare_s)

    @property
    def recording_bytes(self) -> float:
        """Estimated maximum size of the recording."""
        camera = self.bench.camera_model
        frames = (self.warm_up_s + self.seconds) / camera.exposure_s + _MORE_FRAMES
        return frames * camera.rows * camera.columns * 2 * _MARGIN


@contextmanager
def recording_folder(plan: LivePlan, progress: Progress) -> Iterator[Path | None]:
    """Give a new folder for the recording, None without one, and remove it; `InputError` if there is no space."""
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
    check_writable(where)
    folder = Path(tempfile.mkdtemp(prefix="svwfs-benchmark-", dir=where))
    try:
        yield folder / "recording"
    finally:
        with ended_by(lambda *_: None):  # a second Ctrl-C must not interrupt the removal
            progress("removing the recording", 1.0)
            shutil.rmtree(folder)


def memory_s(seconds: float) -> float:
    """Return the duration at the end of a span over which the memory must not grow."""
    return min(_MEMORY_S, seconds * 5 / 6)


def share(frames: FrameTotals) -> float:
    """Share of reconstructed frames among all frames of the camera, lost ones included."""
    taken = frames.acquired + frames.lost
    return frames.reconstructed / taken if taken else math.nan


@dataclass(frozen=True, slots=True, kw_only=True)
class Span:
    """Measurements after the warm-up."""

    first_wavefront_s: float  # since its process was started, with opening and calibrating the devices
    seconds: float
    frames: FrameTotals
    times: dict[TimedStage, StageTimes]  # counts are of the span, statistics of the times that were retained at its end
    memory_mb: tuple[dict[str, float], dict[str, float]]  # by process; at begin and end of the last seconds
    processor_s: dict[str, float]  # by process; empty if unknown

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
        return window / redraws if window and redraws else None

    @property
    def total_mb(self) -> tuple[float, float]:
        """Memory of all processes but the simulated rendering, at begin and end of the last seconds."""
        begin, end = (sum(each.values()) - each.get(processor_time.RENDERING, 0.0) for each in self.memory_mb)
        return begin, end

    def tree(self) -> dict[str, Any]:
        """Return everything for JSON."""
        rates = {"rate_hz": self.rate_hz, "redrawn_hz": self.redrawn_hz}
        return {**asdict(self), **rates, "share": _known(share(self.frames)), "times": timing_facts(self.times)}


def measure_span(
    run: HeadlessRun, began_s: float, warm_up_s: float, seconds: float, record_into: Path | None = None
) -> Generator[None, None, Span]:
    """Make the steps of a run begun at a time; return a span after the warm-up, or raise `RunError` or `InputError`."""
    acquisition = run.acquisition
    first_s = yield from run.first_wavefront(_GIVE_UP_S)
    acquisition.timings.forget_longest()  # of this process; those of the instrument begin with the recording
    if record_into is not None:
        run.send(lambda to: (to.start_recording(record_into, command="benchmark"),))

    def passed() -> float:
        return min(1.0, (time.perf_counter() - first_s) / (warm_up_s + seconds))

    def wait(until_s: float, text: str) -> Iterator[None]:
        return run.until(lambda: time.perf_counter() >= until_s, text=text, fraction=passed)

    yield from wait(first_s + warm_up_s, "warming up")
    stages = run.stage_times()
    start_s, before, taken_s = time.perf_counter(), acquisition.counts, processor_time.processor_times()
    end_s = start_s + seconds
    yield from wait(end_s - memory_s(seconds), "measuring")
    memory_mb = processor_time.memory_mb()
    yield from wait(end_s, "measuring")
    ended_s, after = time.perf_counter(), acquisition.counts
    times = run.stage_times()
    span = Span(
        first_wavefront_s=first_s - began_s,
        seconds=ended_s - start_s,
        frames=FrameTotals(*(now - then for now, then in zip(astuple(after), astuple(before), strict=True))),
        times={stage: replace(each, count=each.count - stages[stage].count) for stage, each in times.items()},
        memory_mb=(memory_mb, processor_time.memory_mb()),
        processor_s={
            process: max(until_s - taken_s.get(process, 0.0), 0.0)
            for process, until_s in processor_time.processor_times().items()
        },
    )
    if record_into is not None:
        run.send(lambda to: (to.stop_recording(),))
        yield from run.until(lambda: is_recorded(acquisition), text="measuring", fraction=lambda: 1.0)
    return span


class Figure(NamedTuple):
    """A line of the table; with a limit, `--check` asks for it, and an unknown value misses it."""

    name: str
    value: float
    unit: str = ""
    key: str = ""  # in JSON, of a figure with a limit
    limit: float = math.nan
    detail: str = ""  # shown instead of the value

    @property
    def measured(self) -> str:
        """The value in words."""
        return self.detail or self._in_words(self.value)

    @property
    def asked(self) -> str:
        """The limit in words; empty without one."""
        return self.key and f"{'>=' if self.key in _AT_LEAST else '<='} {self._in_words(self.limit)}"

    @property
    def is_met(self) -> bool:
        """True if the value keeps the limit."""
        return self.value >= self.limit if self.key in _AT_LEAST else self.value <= self.limit

    def _in_words(self, value: float) -> str:
        scale, digits = _UNITS[self.unit]
        return f"{scale * value:{digits}} {self.unit}".rstrip()


@dataclass(frozen=True, slots=True, kw_only=True)
class LiveFigures:
    """Figures of the run with a window and an optional recording, and of the run without."""

    plan: LivePlan
    is_seen: bool  # the window was on a display
    window: Span
    recording: RecordingState | None  # at its end
    bare: Span  # without window and recording
    processor_s: float | None  # of both runs and all their processes, from start to end; None if unknown

    @property
    def rate_ratio(self) -> float:
        """Rate with the window over the rate without; NaN without any wavefront."""
        return self.window.rate_hz / self.bare.rate_hz if self.bare.rate_hz else math.nan

    @property
    def memory_growth(self) -> float | None:
        """Relative growth of the memory; None if the system does not report it."""
        begin_mb, end_mb = self.window.total_mb
        return end_mb / begin_mb - 1 if begin_mb else None

    def rows(self) -> list[Figure]:
        """Return all figures."""
        window, bare, recording, growth = self.window, self.bare, self.recording, self.memory_growth
        frames, plan = window.frames, self.plan

        def timed(name: str, stage: TimedStage, key: str = "", limit: float = math.nan) -> Figure:
            each = window.times[stage]
            shown = " / ".join(f"{1e3 * seconds:.1f}" for seconds in (each.p50_s, each.p99_s, each.max_s))
            value = each.p99_s if key.endswith("p99_s") else each.max_s
            return Figure(name, value, "ms", key, limit, f"{shown} ms" if each.count else "none")

        least = _LEAST_SHARE_WITH_PANELS if plan.with_panels else _LEAST_SHARE
        rows = [
            Figure("frames acquired", frames.acquired),
            Figure("reconstructed", share(frames), "%", "share", least),
            Figure("lost by the camera", frames.lost, "", "lost", 0),
            timed("camera to result, 99 %", "to_result", "to_result_p99_s", 0.030),
            timed("camera to screen", "to_screen"),
            Figure("window redrawn", window.redrawn_hz, "/s", "redrawn_hz", 20.0),
            timed("longest redraw", "draw", "draw_max_s", 0.1),
        ]
        if (redraw_s := window.redraw_s) is not None:
            rows.append(Figure("processor, each redraw", redraw_s, "ms", "redraw_s", 0.012))
        if recording is not None:
            rows.append(timed("longest write to the disk", "record", "record_max_s", 0.1))
            rows.append(Figure("recorded, with warm-up", recording.frames))
            rows.append(Figure("recordings that ended early", bool(recording.problem), "", "recording_problems", 0))
        if growth is not None:
            last = f"last {memory_s(plan.seconds):.0f} s"
            rows.append(Figure("memory of all processes", window.total_mb[1], "MB", "memory_mb", 1000.0))
            rows.append(Figure(f"memory grown, {last}", growth, "%", "memory_growth", 0.01))
        rows.append(Figure(f"rate without window, {bare.seconds:.0f} s", bare.rate_hz, "/s"))
        rows.append(Figure("rate with it", window.rate_hz, "/s"))
        rows.append(Figure("rate with over without", self.rate_ratio, "%", "rate_ratio", 0.95))
        rows.append(Figure("first wavefront after, warm", window.first_wavefront_s, "s", "first_wavefront_s", 5.0))
        if self.processor_s is not None:
            most_s = _PROCESSOR_S * plan.lasting_s / _PROCESSOR_LASTING_S
            rows.append(Figure("processor, all processes", self.processor_s, "s", "processor_s", most_s))
        return rows

    def limits(self) -> list[Figure]:
        """Return the figures that have a limit."""
        return [each for each in self.rows() if each.key]

    def missed(self) -> list[str]:
        """Return a sentence for every figure that misses its limit."""
        return [f"{each.key} is {each.value:.3g}, asked {each.asked}" for each in self.limits() if not each.is_met]

    def tree(self) -> dict[str, Any]:
        """Return everything for JSON, with computer and libraries."""
        plan, recording = self.plan, self.recording
        live = {
            "seconds": plan.seconds,
            "warm_up_s": plan.warm_up_s,
            "window_is_seen": self.is_seen,
            "bench": write_bench(plan.bench),
            "window": self.window.tree(),
            "without_window": self.bare.tree(),
            "memory_s": memory_s(plan.seconds),
            "processor_s": self.processor_s,
            "recording": None if recording is None else {"frames": recording.frames, "problem": recording.problem},
            "limits": {
                each.key: {"value": _known(each.value), "limit": each.limit, "is_met": each.is_met}
                for each in self.limits()
            },
        }
        return {"live": live, "machine": machine_facts(), "versions": versions()}


def _known(value: float) -> float | None:
    """JSON has no NaN."""
    return None if math.isnan(value) else value
