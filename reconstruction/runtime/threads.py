"""Persistent worker threads, and process-wide settings, such as the threads of BLAS."""

import os
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager, suppress
from functools import cache, lru_cache
from pathlib import Path
from threading import RLock
from typing import TypeVar

from threadpoolctl import ThreadpoolController  # type: ignore[import-untyped] # ships no types

A = TypeVar("A")
R = TypeVar("R")

THREADS = 2  # that share a piece of work, unless a setting or the caller says otherwise
_SWITCH_INTERVAL_S = 0.0005
_LETTERS = 15  # of a thread's name that Linux keeps


class ProcessSetting:
    """A setting in force while at least one `with ... .wanted()` block runs, in any thread."""

    def __init__(self, begin: Callable[[], Callable[[], object]]) -> None:
        """`begin` applies the setting and returns a function that restores the previous state."""
        self._begin = begin
        self._changing = RLock()  # re-entrant: garbage collection may end another block here
        self._wanted_by = 0
        self._restore: Callable[[], object] | None = None

    @contextmanager
    def wanted(self) -> Iterator[None]:
        """Keep the setting in force inside a `with` block."""
        with self._changing:
            self._wanted_by += 1
            if self._restore is None:
                self._restore = self._begin()
        try:
            yield
        finally:
            with self._changing:
                self._wanted_by -= 1
                if not self._wanted_by and self._restore is not None:
                    self._restore()
                    self._restore = None


@cache
def worker_pool(threads: int) -> ThreadPoolExecutor:
    """Pool of that many threads besides the caller, shared by the whole process."""
    return ThreadPoolExecutor(threads, thread_name_prefix="reconstruction")


def in_threads(function: Callable[[A], R], items: Iterable[A], threads: int = THREADS) -> list[R]:
    """Results of a function for each item, which some threads share; it should spend its time without Python's lock."""
    waiting = list(enumerate(items))
    results, left = dict[int, R](), iter(waiting)

    def work() -> None:
        for place, item in left:  # taking the next one is indivisible
            results[place] = function(item)

    others = [worker_pool(threads - 1).submit(work) for _ in range(1, min(threads, len(waiting)))]
    work()
    for other in others:
        if not other.cancel():
            other.result()
    return [results[place] for place, _ in waiting]


if hasattr(os, "register_at_fork"):  # a forked process inherits the pools, but not their threads
    os.register_at_fork(after_in_child=worker_pool.cache_clear)


def name_threads() -> None:
    """Give Linux the names of this process's threads, for `svwfs benchmark --live` and `top -H`.

    Python does so itself from version 3.14 on.
    """
    for thread in threading.enumerate():
        with suppress(OSError):
            Path(f"/proc/self/task/{thread.native_id}/comm").write_text(thread.name[:_LETTERS])


def one_blas_thread() -> AbstractContextManager[None]:
    """Limit BLAS to one thread in the whole process inside a `with` block.

    The threads of BLAS spin while they wait for one another: on a busy computer a decomposition of 30 ms takes half a
    second, and frames are lost. One thread also adds sums in a fixed order, so that results repeat.
    """
    return _one_blas_thread.wanted()


def _limit_blas() -> Callable[[], object]:
    limit: Callable[[], object] = _libraries(len(sys.modules)).limit(limits=1, user_api="blas").restore_original_limits
    return limit


@lru_cache(maxsize=1)
def _libraries(_modules: int) -> ThreadpoolController:
    """The loaded libraries, which take a millisecond to find; more are loaded only with more modules."""
    return ThreadpoolController()


_one_blas_thread = ProcessSetting(_limit_blas)


def short_switch_interval() -> AbstractContextManager[None]:
    """Switch Python threads every 0.5 ms instead of 5 ms inside a `with`.

    A thread waits for its turn after each system call: beside a busy window, writing a frame (ten calls) would take up
    to 50 ms instead of 5. Several acquisitions may nest this in any order.
    """
    return _short_switch_interval.wanted()


def _shorten_switch_interval() -> Callable[[], object]:
    before_s = sys.getswitchinterval()
    sys.setswitchinterval(_SWITCH_INTERVAL_S)
    return lambda: sys.setswitchinterval(before_s)


_short_switch_interval = ProcessSetting(_shorten_switch_interval)
