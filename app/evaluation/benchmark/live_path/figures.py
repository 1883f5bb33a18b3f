"""The figures of both runs, what is asked of them, and all of it as JSON."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

from app.bench.config import write_bench
from app.evaluation.benchmark.live_path.course import Span
from app.evaluation.benchmark.live_path.plan import LivePlan
from app.recording.recorder import RecordingState
from app.run_facts import timing_facts


@dataclass(frozen=True, slots=True)
class Verdict:
    """One figure beside its limit."""

    value: float
    limit: float
    asked: str  # the limit in words
    is_met: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class LiveFigures:
    """What was measured with a window and, if there was to be one, a recording, and then without either."""

    plan: LivePlan
    is_seen: bool  # whether the window was on a display
    window: Span
    recording: RecordingState | None  # as it had ended
    bare: Span  # without window and recording

    @property
    def rate_ratio(self) -> float:
        """The rate of the run with a window over that of the one without; NaN when that yielded nothing."""
        return self.window.rate_hz / self.bare.rate_hz if self.bare.rate_hz else math.nan

    @property
    def memory_growth(self) -> float | None:
        """The share by which the memory has grown; None where the system does not tell it."""
        begin_mb, end_mb = self.window.memory_mb
        return None if begin_mb is None or end_mb is None else end_mb / begin_mb - 1

    def verdicts(self) -> dict[str, Verdict]:
        """Hold what was measured against what is asked, by names for JSON; what is not known meets nothing."""
        window = self.window
        times = window.timings.summary()
        verdicts = {
            "share": _at_least(window.frames.share, 0.999, ">= 99.9 %"),
            "lost": _at_most(window.frames.lost, 0, "none"),
            "to_result_p99_s": _below(times["to_result"].p99_s, 0.030, "99 % < 30 ms"),
            "redrawn_hz": _at_least(window.redrawn_hz, 20.0, ">= 20 /s"),
            "rate_ratio": _at_least(self.rate_ratio, 0.95, ">= 95 %"),
            "first_wavefront_s": _below(window.first_wavefront_s, 15.0, "< 15 s, warm"),
        }
        if self.memory_growth is not None:
            verdicts["memory_growth"] = _below(self.memory_growth, 0.02, "< 2 %")
        if self.recording is not None:
            verdicts["record_p99_s"] = _below(times["record"].p99_s, 0.015, "99 % < 15 ms")
            verdicts["recording_problems"] = _at_most(bool(self.recording.problem), 0, "all frames")
        return verdicts

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        plan, recording = self.plan, self.recording
        begin_mb, end_mb = self.window.memory_mb
        return {
            "seconds": plan.seconds,
            "warm_up_s": plan.warm_up_s,
            "window_is_seen": self.is_seen,
            "bench": write_bench(plan.bench),
            "first_wavefront_s": self.window.first_wavefront_s,
            "window": _as_dict(self.window),
            "without_window": _as_dict(self.bare),
            "rate_ratio": _known(self.rate_ratio),
            "memory": {
                "seconds": plan.memory_s,
                "begin_mb": begin_mb,
                "end_mb": end_mb,
                "growth": self.memory_growth,
            },
            "recording": None if recording is None else {"frames": recording.frames, "problem": recording.problem},
            "limits": {
                name: {"value": _known(each.value), "limit": each.limit, "is_met": each.is_met}
                for name, each in self.verdicts().items()
            },
        }


def _as_dict(span: Span) -> dict[str, Any]:
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


def _at_least(value: float, limit: float, asked: str) -> Verdict:
    return Verdict(value, limit, asked, value >= limit)


def _at_most(value: float, limit: float, asked: str) -> Verdict:
    return Verdict(value, limit, asked, value <= limit)


def _below(value: float, limit: float, asked: str) -> Verdict:
    return Verdict(value, limit, asked, value < limit)
