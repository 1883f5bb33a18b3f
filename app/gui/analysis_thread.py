"""A thread that analyses one request at a time for the panels of the window."""

import math
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Generic, Protocol, Self, TypeVar

from threadpoolctl import ThreadpoolController  # type: ignore[import-untyped] # ships no types

_SHARE = 0.2  # of a core: the measurement needs the rest


class Request(Protocol):
    """Request to compute something from a measurement; equal requests have equal results."""

    @property
    def interval_s(self) -> float:
        """Time between two analyses of a running measurement."""
        ...

    def follows(self, other: Self) -> bool:
        """Return whether it asks the same of another measurement."""
        ...


R = TypeVar("R", bound=Request)
A = TypeVar("A")


class AnalysisThread(Generic[R, A]):
    """Analyses one request at a time, and a running measurement at intervals."""

    def __init__(self, analyse: Callable[[R], A]) -> None:
        self._executor = ThreadPoolExecutor(1, thread_name_prefix="analysis")
        self._libraries = ThreadpoolController()
        self._analyse = analyse
        self._request: R | None = None
        self._future: Future[A] | None = None
        self._requested_s = -math.inf
        self._taken_s = 0.0  # by the last analysis

    def submit(self, request: R) -> None:
        """Analyse a request unless the thread is busy or the request is unchanged.

        A new measurement alone waits until the interval is over, and long enough that analyses take only a share of a
        core; any other change is analysed immediately.
        """
        if self._future is not None or request == self._request:
            return
        is_newer = self._request is not None and self._request.follows(request)
        if is_newer and time.monotonic() < self._requested_s + max(request.interval_s, self._taken_s / _SHARE):
            return
        self._request, self._requested_s = request, time.monotonic()
        self._future = self._executor.submit(self._run, request)

    def take(self) -> A | None:
        """Return a finished analysis once, or raise its error; None if there is none."""
        if self._future is None or not self._future.done():
            return None
        future, self._future = self._future, None
        return future.result()

    def forget(self) -> None:
        """Drop the last request, and its answer."""
        self._request = self._future = None

    def close(self) -> None:
        """Wait for the current analysis and end the thread."""
        self._executor.shutdown(cancel_futures=True)

    def _run(self, request: R) -> A:
        """Analyse on one core: waiting BLAS threads take five times as long beside a measurement."""
        begun_s = time.monotonic()
        try:
            with self._libraries.limit(limits=1, user_api="blas"):
                return self._analyse(request)
        finally:
            self._taken_s = time.monotonic() - begun_s
