"""Course of a run without a user: steps that a loop or the timer of a window makes, some times a second, to its end."""

import time
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import Future
from typing import Any

from app.acquisition.carrier import Carrier
from app.acquisition.start_up import start_up
from app.errors import InputError, RunError
from app.measurement.measurement import SKIPPED, Measurement
from app.measurement.routines import Cancelled
from app.progress import Progress

_HOPELESS_FRAMES = 20  # without a wavefront, when the bench is calibrated


class FirstWavefront:
    """Waits for the first wavefront of an acquisition, which a loop or the timer of a window polls."""

    def __init__(self, within_s: float) -> None:
        """Give up after this time, or some frames without a wavefront."""
        self._within_s, self._began_s = within_s, time.perf_counter()
        self.came_s: float | None = None  # by time.perf_counter()
        self._failed, self._problem = 0, ""

    def take(self, measurement: Measurement) -> None:
        """Take note of a frame of the calibrated bench."""
        if measurement.wavefront is not None:
            self.came_s = time.perf_counter() if self.came_s is None else self.came_s
        elif measurement.problem != SKIPPED:
            self._failed, self._problem = self._failed + 1, measurement.problem

    def check(self) -> None:
        """Raise `RunError` if it has not come, and there is no hope of it."""
        if self.came_s is None and self._failed >= _HOPELESS_FRAMES:
            raise RunError(f"no wavefront in the first {self._failed} frames: {self._problem}")
        if self.came_s is None and time.perf_counter() > self._began_s + self._within_s:
            raise RunError(f"no wavefront within {self._within_s:g} s: {self._problem or 'no frame came'}")


class Course:
    """Steps of one instrument, each of which raises `RunError` or `InputError` if the run cannot go on.

    `progress` is told what they wait for.
    """

    def __init__(self, acquisition: Carrier, progress: Progress = lambda *_: None) -> None:
        self.acquisition, self._progress = acquisition, progress
        self._expected: tuple[Future[Any], ...] = ()  # commands that must succeed

    def begin(self, commands: Callable[[Carrier], tuple[Future[Any], ...]] = start_up) -> tuple[Future[Any], ...]:
        """Send commands that must succeed, such as those that calibrate the bench and turn to the sample."""
        sent = commands(self.acquisition)
        self._expected += sent
        return sent

    def first_wavefront(self, within_s: float) -> Generator[None, None, float]:
        """Wait for the first wavefront after all commands; return when it came, by time.perf_counter()."""
        acquisition, first, seen = self.acquisition, FirstWavefront(within_s), None
        while first.came_s is None:
            self._check()
            newest = acquisition.newest
            if newest is not None and newest is not seen and all(step.done() for step in self._expected):
                first.take(newest)
            seen = newest
            first.check()
            self._progress(acquisition.activity.text or "waiting for the first wavefront", 0.0)
            yield
        return first.came_s

    def until(
        self, is_over: Callable[[], bool], text: str = "", fraction: Callable[[], float] = lambda: 0.0
    ) -> Iterator[None]:
        """Wait, a `fraction` of it done, until it is over."""
        while not is_over():
            self._check()
            self._progress(text, fraction())
            yield

    def is_recorded(self) -> bool:
        """Return whether the recording is over; True without one."""
        state = self.acquisition.recording
        return state is None or state.is_over

    def _check(self) -> None:
        errors = (self.acquisition.error, *(step.exception() for step in self._expected if step.done()))
        error = next((each for each in errors if each is not None and not isinstance(each, Cancelled)), None)
        if error is None:  # a command is cancelled by someone who goes on, or closes
            return
        if isinstance(error, InputError | RunError):
            raise error
        raise RunError(self.acquisition.failure or str(error) or type(error).__name__) from error
