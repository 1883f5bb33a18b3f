"""The queue of commands of the thread that owns the devices."""

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

# passed to the caller; the thread goes on
_HARMLESS = (Cancelled, RoutineError, ReconstructionError, InputError, BadValue, Unsupported, WrongState)


def done() -> Future[None]:
    """Return the future of what is done already."""
    future: Future[None] = Future()
    future.set_result(None)
    return future


class CommandQueue:
    """Accepts commands from any thread until it is closed; each gets a future.

    `afterwards` runs after a command that did not stop the worker, before its future resolves.
    """

    def __init__(self, afterwards: Callable[[Instrument], None]) -> None:
        self._afterwards = afterwards
        self._waiting: queue.Queue[tuple[Callable[[Instrument], None], Future[Any]]] = queue.Queue()
        self._ending = threading.Lock()  # no command may slip in while the queue closes
        self._refusal: str | None = None  # why commands are refused; None while they are accepted

    def submit(self, command: Callable[[Instrument], T]) -> Future[T]:
        """Append a command; its future has a `WrongState` if the queue is closed."""
        future: Future[T] = Future()

        def execute(instrument: Instrument) -> None:
            if not future.set_running_or_notify_cancel():
                return
            try:
                try:
                    resolve = partial(future.set_result, command(instrument))
                except _HARMLESS as error:
                    resolve = partial(future.set_exception, error)
                self._afterwards(instrument)
            except BaseException as error:
                future.set_exception(error)
                raise
            resolve()

        with self._ending:
            if self._refusal is None:
                self._waiting.put((execute, future))
            else:
                future.set_exception(WrongState(self._refusal))
        return future

    @property
    def is_empty(self) -> bool:
        """True if no command waits."""
        return self._waiting.empty()

    def next(self, timeout_s: float = 0.0) -> Callable[[Instrument], None] | None:
        """Remove the next command, to be called by the worker; None if none arrives within `timeout_s`.

        The command raises only errors that end the worker: a failing device or a bug.
        """
        try:
            execute, _ = self._waiting.get(block=timeout_s > 0, timeout=timeout_s)
        except queue.Empty:
            return None
        return execute

    def close(self, refusal: str) -> None:
        """Refuse all waiting and future commands for this reason."""
        with self._ending:
            self._refusal = refusal
        while not self.is_empty:
            _, future = self._waiting.get()
            if future.set_running_or_notify_cancel():
                future.set_exception(WrongState(refusal))
