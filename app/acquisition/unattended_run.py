"""A run without a user: steps to its end, made by a loop or by the timer of a window."""

import time
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import Future
from typing import Any

from app.acquisition.running_instrument import RunningInstrument
from app.acquisition.start_up import start_up
from app.errors import InputError, RunError
from app.measurement.routines import Cancelled
from app.progress import Progress

_HOPELESS_FRAMES = 20  # without a wavefront, when the bench is calibrated


class UnattendedRun:
    """Steps of one instrument, made some times a second; one raises `RunError` or `InputError` if it cannot go on.

    `progress` receives what they wait for.
    """

    def __init__(self, acquisition: RunningInstrument, progress: Progress = lambda *_: None) -> None:
        self.acquisition, self._progress = acquisition, progress
        self._expected: tuple[Future[Any], ...] = ()  # commands that must succeed

    def send(
        self, commands: Callable[[RunningInstrument], tuple[Future[Any], ...]] = start_up
    ) -> tuple[Future[Any], ...]:
        """Send commands that must succeed, such as those that calibrate the bench and turn to the sample."""
        sent = commands(self.acquisition)
        self._expected += sent
        return sent

    def first_wavefront(self, within_s: float) -> Generator[None, None, float]:
        """Wait for the first wavefront after all commands; return when it came, by time.perf_counter().

        `RunError` if it does not come in that time, or in some frames.
        """
        acquisition, seen, failed, problem = self.acquisition, None, 0, ""
        end_s = time.perf_counter() + within_s
        while True:
            self._check()
            newest = acquisition.newest
            if newest is not None and newest is not seen and all(step.done() for step in self._expected):
                if newest.wavefront is not None:
                    return time.perf_counter()
                if not newest.is_skipped:
                    failed, problem = failed + 1, newest.problem
            seen = newest
            if failed >= _HOPELESS_FRAMES:
                raise RunError(f"no wavefront in the first {failed} frames: {problem}")
            if time.perf_counter() > end_s:
                raise RunError(f"no wavefront within {within_s:g} s: {problem or 'no frame came'}")
            self._progress(acquisition.activity.text or "waiting for the first wavefront", 0.0)
            yield

    def until(
        self, is_over: Callable[[], bool], *, text: str = "", fraction: Callable[[], float] = lambda: 0.0
    ) -> Iterator[None]:
        """Wait, a `fraction` of it done, until it is over."""
        while not is_over():
            self._check()
            self._progress(text, fraction())
            yield

    def is_recorded(self) -> bool:
        """True if the recording is over, or there is none."""
        state = self.acquisition.recording
        return state is None or state.is_over

    def _check(self) -> None:
        errors = (self.acquisition.error, *(step.exception() for step in self._expected if step.done()))
        # A command is cancelled by someone who goes on, or closes.
        error = next((each for each in errors if each is not None and not isinstance(each, Cancelled)), None)
        if error is None:
            return
        if isinstance(error, InputError | RunError):
            raise error
        raise RunError(self.acquisition.failure or str(error) or type(error).__name__) from error
