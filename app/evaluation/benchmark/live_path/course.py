"""One run: first wavefront, warm-up, measured span. A window's timer or a loop polls it some ten times a second."""

import time
from collections.abc import Generator, Iterator
from concurrent.futures import Future
from dataclasses import dataclass
from math import ceil
from pathlib import Path
from typing import Any

from app.acquisition.session import FirstWavefront
from app.acquisition.start_up import start_up
from app.acquisition.worker import Acquisition
from app.bench.config import Bench
from app.errors import InputError, RunError
from app.evaluation.benchmark.live_path.tally import FrameCounts, Tally, resident_mb
from app.progress import Progress
from app.timing import Timings

_GIVE_UP_S = 600.0  # for rendering the bench and compiling
_DONE = object()


@dataclass(frozen=True, slots=True, kw_only=True)
class Span:
    """Measurements after the warm-up."""

    first_wavefront_s: float  # since the course was made, with opening and calibrating the devices
    began_s: float  # by time.perf_counter()
    seconds: float
    frames: FrameCounts
    timings: Timings  # of the span only
    memory_mb: tuple[float | None, float | None]  # resident, at begin and end of its last seconds

    @property
    def rate_hz(self) -> float:
        """Wavefronts a second."""
        return self.frames.reconstructed / self.seconds

    @property
    def redrawn_hz(self) -> float:
        """Rate at which a window showed something new."""
        return self.timings.summary()["draw"].count / self.seconds


class Course:
    """One run of its own acquisition, which the caller starts and closes."""

    def __init__(
        self,
        bench: Bench,
        progress: Progress,
        *,
        warm_up_s: float,
        seconds: float,
        memory_s: float = 0.0,
        record_into: Path | None = None,
    ) -> None:
        """Prepare a span of `seconds` after the warm-up; the memory is measured over its last `memory_s`."""
        self._tally, self._first = Tally(), FirstWavefront(_GIVE_UP_S)
        self.acquisition = Acquisition(bench, sinks=(self._tally.take, self._first.take))
        self._progress, self._record_into = progress, record_into
        self._warm_up_s, self._seconds, self._memory_s = warm_up_s, seconds, memory_s
        self._kept = 2 * ceil(seconds / bench.camera_model.exposure_s)
        self._expected: tuple[Future[Any], ...] = ()
        self._span: Span | None = None
        self._made_s = time.perf_counter()
        self._steps = self._run()

    def begin(self) -> tuple[Future[Any], ...]:
        """Calibrate the started acquisition and turn to the sample."""
        self._expected = start_up(self.acquisition)
        return self._expected

    def poll(self) -> bool:
        """Run the steps that are due; True at the end. Raises `RunError` or `InputError` if a step fails."""
        return next(self._steps, _DONE) is _DONE

    @property
    def span(self) -> Span:
        """The measured span."""
        if self._span is None:
            raise RunError("the run ended before all was measured")
        return self._span

    def _run(self) -> Iterator[None]:
        first_s = yield from self._until_first_wavefront()
        if self._record_into is not None:
            self._expected += (self.acquisition.start_recording(self._record_into, command="benchmark"),)
        yield from self._wait(first_s + self._warm_up_s, first_s, "warming up")
        began_s, before = time.perf_counter(), self._tally.counts
        timings, end_s = self.acquisition.timings.begin_span(self._kept), began_s + self._seconds
        yield from self._wait(end_s - self._memory_s, first_s, "measuring")
        memory_mb = resident_mb()
        yield from self._wait(end_s, first_s, "measuring")
        ended_s, after = time.perf_counter(), self._tally.counts
        self.acquisition.timings.end_span(timings)
        self._span = Span(
            first_wavefront_s=first_s - self._made_s,
            began_s=began_s,
            seconds=ended_s - began_s,
            frames=after.since(before),
            timings=timings,
            memory_mb=(memory_mb, resident_mb()),
        )

    def _until_first_wavefront(self) -> Generator[None, None, float]:
        while (first_s := self._first.came_s) is None:
            self._check()
            self._first.check()
            activity = self.acquisition.activity
            self._progress(activity.text or "waiting for the first wavefront", 0.0)
            yield
        return first_s

    def _wait(self, until_s: float, first_s: float, text: str) -> Iterator[None]:
        while (now_s := time.perf_counter()) < until_s:
            self._check()
            self._progress(text, min(1.0, (now_s - first_s) / (self._warm_up_s + self._seconds)))
            yield

    def _check(self) -> None:
        """Raise the error that stopped the acquisition, if any."""
        failed = (step.exception() for step in self._expected if step.done())
        error = self.acquisition.error or next(filter(None, failed), None)
        if error is None:
            return
        if isinstance(error, InputError | RunError):
            raise error
        raise RunError(self.acquisition.failure or str(error) or type(error).__name__) from error
