"""Figures of both runs with their limits, as JSON and as a table on the terminal."""

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from operator import ge, le, lt
from typing import Any

from app.bench.config import write_bench
from app.evaluation.benchmark.live_path.course import Span
from app.evaluation.benchmark.live_path.plan import LivePlan
from app.recording.recorder import RecordingState
from app.run_facts import machine_facts, timing_facts, versions


@dataclass(frozen=True, slots=True)
class LimitCheck:
    """One figure beside its limit."""

    value: float
    limit: float
    asked: str  # the limit in words
    is_met: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class LiveFigures:
    """Figures of the run with a window and an optional recording, and of the run without."""

    plan: LivePlan
    is_seen: bool  # the window was on a display
    window: Span
    recording: RecordingState | None  # at its end
    bare: Span  # without window and recording

    @property
    def rate_ratio(self) -> float:
        """Rate with the window over the rate without; NaN without any wavefront."""
        return self.window.rate_hz / self.bare.rate_hz if self.bare.rate_hz else math.nan

    @property
    def memory_growth(self) -> float | None:
        """Relative growth of the memory; None if the system does not report it."""
        begin_mb, end_mb = self.window.memory_mb
        return None if begin_mb is None or end_mb is None else end_mb / begin_mb - 1

    def checks(self) -> dict[str, LimitCheck]:
        """Compare the figures with their limits, by name in the JSON; unknown figures meet none."""
        window = self.window
        times = window.timings.summary()
        checks = {
            "share": _check(window.frames.share, ge, 0.999, ">= 99.9 %"),
            "lost": _check(window.frames.lost, le, 0, "none"),
            "to_result_p99_s": _check(times["to_result"].p99_s, lt, 0.030, "99 % < 30 ms"),
            "redrawn_hz": _check(window.redrawn_hz, ge, 20.0, ">= 20 /s"),
            **({} if self.plan.with_panels else {"draw_p50_s": _check(times["draw"].p50_s, le, 0.008, "half <= 8 ms")}),
            "rate_ratio": _check(self.rate_ratio, ge, 0.95, ">= 95 %"),
            "first_wavefront_s": _check(window.first_wavefront_s, lt, 15.0, "< 15 s, warm"),
        }
        if self.memory_growth is not None:
            checks["memory_growth"] = _check(self.memory_growth, lt, 0.02, "< 2 %")
        if self.recording is not None:
            checks["record_p99_s"] = _check(times["record"].p99_s, lt, 0.015, "99 % < 15 ms")
            checks["recording_problems"] = _check(bool(self.recording.problem), le, 0, "all frames")
        return checks

    def missed(self) -> list[str]:
        """Return a sentence for every figure that misses its limit."""
        missed = {name: each for name, each in self.checks().items() if not each.is_met}
        return [f"{name} is {each.value:.3g}, asked {each.asked}" for name, each in missed.items()]

    def tree(self) -> dict[str, Any]:
        """Return everything for JSON, with computer and libraries."""
        plan, recording = self.plan, self.recording
        begin_mb, end_mb = self.window.memory_mb
        memory = {"seconds": plan.memory_s, "begin_mb": begin_mb, "end_mb": end_mb, "growth": self.memory_growth}
        live = {
            "seconds": plan.seconds,
            "warm_up_s": plan.warm_up_s,
            "window_is_seen": self.is_seen,
            "bench": write_bench(plan.bench),
            "first_wavefront_s": self.window.first_wavefront_s,
            "window": _span_tree(self.window),
            "without_window": _span_tree(self.bare),
            "rate_ratio": _known(self.rate_ratio),
            "memory": memory,
            "recording": None if recording is None else {"frames": recording.frames, "problem": recording.problem},
            "limits": {
                name: {"value": _known(each.value), "limit": each.limit, "is_met": each.is_met}
                for name, each in self.checks().items()
            },
        }
        return {"live": live, "machine": machine_facts(), "versions": versions()}


def _span_tree(span: Span) -> dict[str, Any]:
    return {
        "seconds": span.seconds,
        "frames": asdict(span.frames),
        "share": _known(span.frames.share),
        "rate_hz": span.rate_hz,
        "redrawn_hz": span.redrawn_hz,
        "timings": timing_facts(span.timings),
    }


def _known(value: float) -> float | None:
    """JSON has no NaN."""
    return None if math.isnan(value) else value


def _check(value: float, holds: Callable[[float, float], bool], limit: float, asked: str) -> LimitCheck:
    return LimitCheck(value, limit, asked, holds(value, limit))
