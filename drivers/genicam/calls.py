"""Calls into a library that may hang, made so that the program never hangs with it."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future, wait
from queue import SimpleQueue
from typing import Any, TypeVar

from drivers.errors import Disconnected

T = TypeVar("T")
_LAST_LOOK_S = 0.2


class PatientCalls:
    """One thread that makes the calls in turn, while the caller waits for each only as long as it wants to.

    Aravis tries for 2.5 s to reach a camera that is gone, for every register anew. Whoever was waiting is told that the
    camera does not answer, and what has hung ends by itself in the thread, which does not keep the program from ending.
    """

    def __init__(self, name: str) -> None:
        self._waiting: SimpleQueue[tuple[Future[Any], Callable[[], Any]] | None] = SimpleQueue()
        threading.Thread(target=self._run, name=name, daemon=True).start()

    def submit(self, call: Callable[[], T]) -> Future[T]:
        """Have the call made after those before it."""
        future: Future[T] = Future()
        self._waiting.put((future, call))
        return future

    def make(self, call: Callable[[], T], patience_s: float) -> T:
        """Return what the call returns or raise what it raises; `Disconnected` if that takes too long."""
        future = self.submit(call)
        if wait((future,), patience_s).not_done and not comes_now(future):
            raise Disconnected(f"the camera did not answer for {patience_s:.1f} s: is it connected and on?")
        return future.result()

    def end(self) -> None:
        """Let the thread end after the calls that were submitted."""
        self._waiting.put(None)

    def _run(self) -> None:
        while (item := self._waiting.get()) is not None:
            future, call = item
            try:
                future.set_result(call())
            except BaseException as error:  # noqa: BLE001 - whoever waits for it gets it
                future.set_exception(error)


def comes_now(future: Future[Any]) -> bool:
    """Whether an overdue answer comes after all, as where it was this computer that stood still, not the camera."""
    return bool(wait((future,), _LAST_LOOK_S).done)
