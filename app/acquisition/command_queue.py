"""What others want done by the one thread that owns the devices, in the order in which they asked."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from concurrent.futures import Future
from functools import partial
from typing import Any, TypeVar

from app.acquisition.instrument import Instrument
from app.errors import InputError
from app.measurement.routines import Cancelled, RoutineError
from drivers.interface import BadValue, Unsupported, WrongState
from reconstruction.errors import ReconstructionError

T = TypeVar("T")

_HARMLESS = (
    Cancelled,
    RoutineError,
    ReconstructionError,
    InputError,
    BadValue,
    Unsupported,
    WrongState,
)  # the caller's business; the thread goes on


class CommandQueue:
    """Takes commands from any thread until it is closed; each one's result or error comes by its future.

    What `afterwards` does of a command that ended nothing, is done before its future tells anybody.
    """

    def __init__(self, afterwards: Callable[[Instrument], None]) -> None:
        self._afterwards = afterwards
        self._waiting: queue.Queue[tuple[Callable[[Instrument], None], Future[Any]]] = queue.Queue()
        self._ending = threading.Lock()  # so that no command slips in between the last look and the end
        self._refusal: str | None = None  # why no more are taken; None as long as they are

    def submit(self, command: Callable[[Instrument], T]) -> Future[T]:
        """Have `command` executed after those that wait already; `WrongState` when nobody will any more."""
        future: Future[T] = Future()

        def execute(instrument: Instrument) -> None:
            if future.set_running_or_notify_cancel():
                try:
                    tell = _answer(command, instrument, future)
                    self._afterwards(instrument)
                except BaseException as error:
                    future.set_exception(error)
                    raise
                tell()

        with self._ending:
            if self._refusal is None:
                self._waiting.put((execute, future))
            else:
                future.set_exception(WrongState(self._refusal))
        return future

    @property
    def is_empty(self) -> bool:
        """Whether nobody wants anything."""
        return self._waiting.empty()

    def next(self, timeout_s: float = 0.0) -> Callable[[Instrument], None] | None:
        """Take the next one out, to be called by who owns the devices; None when none comes within `timeout_s`.

        It raises what ends that thread: a device that fails, a fault of ours.
        """
        try:
            execute, _ = self._waiting.get(block=timeout_s > 0, timeout=timeout_s)
        except queue.Empty:
            return None
        return execute

    def close(self, refusal: str) -> None:
        """Refuse all that wait, and all that are still to come, for this reason."""
        with self._ending:
            self._refusal = refusal
        while not self.is_empty:
            _, future = self._waiting.get()
            if future.set_running_or_notify_cancel():
                future.set_exception(WrongState(refusal))


def _answer(command: Callable[[Instrument], T], instrument: Instrument, future: Future[T]) -> Callable[[], None]:
    """Execute the command; return what tells its result, or its harmless error, to whoever waits for it."""
    try:
        return partial(future.set_result, command(instrument))
    except _HARMLESS as error:
        return partial(future.set_exception, error)
