"""Threads that stay, so that a frame need not make any; and how many of them BLAS may have."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from threading import RLock

from threadpoolctl import threadpool_limits  # type: ignore[import-untyped] # ships no types


@cache
def worker_pool(threads: int) -> ThreadPoolExecutor:
    """So many threads beside the one that asks, the same for the whole program."""
    return ThreadPoolExecutor(threads, thread_name_prefix="reconstruction")


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Let BLAS work in one thread while a `with` lasts, in all of the process: live, and wherever live is repeated.

    Its own threads wait for one another at full speed: on a busy computer that takes half a second for a decomposition
    of 30 ms, and frames are lost. And in one thread sums are always added in the same order. Several threads may ask
    for it; whoever is the last to leave, and nobody before, takes the limit away.
    """
    _limit.enter()
    try:
        yield
    finally:
        _limit.leave()


class _SharedLimit:
    """BLAS's limit, and how many ask for it; the library's own would end with the first of them that leaves."""

    def __init__(self) -> None:
        self._changing = RLock()  # also when, in the middle of it, a forgotten generator leaves in the same thread
        self._asking = 0
        self._limits: threadpool_limits | None = None

    def enter(self) -> None:
        with self._changing:
            self._asking += 1
            if self._limits is None:
                self._limits = threadpool_limits(1, user_api="blas")

    def leave(self) -> None:
        with self._changing:
            self._asking -= 1
            if not self._asking and self._limits is not None:
                self._limits.restore_original_limits()
                self._limits = None


_limit = _SharedLimit()
