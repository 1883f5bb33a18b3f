"""The queue of commands of the thread that owns the devices."""

import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from functools import partial
from typing import Any, Concatenate, ParamSpec, TypeVar

from app.acquisition.instrument import Instrument
from drivers.interface import REFUSALS, DeviceError, OffCount, WrongState

P = ParamSpec("P")
T = TypeVar("T")


def done() -> Future[None]:
    """Return the future of what is done already."""
    future: Future[None] = Future()
    future.set_result(None)
    return future


class CommandQueue:
    """Accepts commands from any thread until it is closed; each gets a future.

    An error of a command goes to its future, whatever it is; only a failing device ends the worker. `afterwards` runs
    after each other command, before its future resolves. A command may not light a light that has gone off since it was
    submitted. None begins while another thread holds `lock`.
    """

    def __init__(self, off_count: OffCount, afterwards: Callable[[Instrument], None]) -> None:
        self._off_count, self._afterwards = off_count, afterwards
        self.lock = threading.Condition()
        self._waiting: deque[tuple[Callable[[Instrument], None], Future[Any]]] = deque()
        self._refusal: str | None = None  # why commands are refused; None while they are accepted

    def submit(
        self, command: Callable[Concatenate[Instrument, P], T], /, *arguments: P.args, **named: P.kwargs
    ) -> Future[T]:
        """Append a command; its future has a `WrongState` if the queue is closed."""
        future: Future[T] = Future()
        made_at = self._off_count.now

        def execute(instrument: Instrument) -> None:
            if not future.set_running_or_notify_cancel():
                return
            self._off_count.begin_command(made_at)
            try:
                try:
                    resolve = partial(future.set_result, command(instrument, *arguments, **named))
                except Exception as error:
                    if isinstance(error, DeviceError) and not isinstance(error, REFUSALS):
                        raise
                    resolve = partial(future.set_exception, error)
                self._afterwards(instrument)
            except BaseException as error:
                future.set_exception(error)
                raise
            resolve()

        with self.lock:
            if self._refusal is None:
                self._waiting.append((execute, future))
                self.lock.notify()
                return future
        future.set_exception(WrongState(self._refusal))
        return future

    @property
    def is_empty(self) -> bool:
        """True if no command waits."""
        return not self._waiting

    def next(self, timeout_s: float = 0.0) -> Callable[[Instrument], None] | None:
        """Remove the next command, which raises only what ends the worker; None if none arrives in `timeout_s`."""
        if self.is_empty and not timeout_s:  # without the lock: between two frames nothing may wait for it
            return None
        with self.lock:
            self.lock.wait_for(lambda: self._waiting, timeout_s)
            return self._waiting.popleft()[0] if self._waiting else None

    def close(self, refusal: str) -> None:
        """Refuse all waiting and future commands for this reason."""
        with self.lock:
            self._refusal = refusal
        for _, future in self._waiting:
            if future.set_running_or_notify_cancel():
                future.set_exception(WrongState(refusal))
