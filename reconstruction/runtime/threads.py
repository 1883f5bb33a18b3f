"""Persistent worker threads, and the threads of BLAS."""

import os
import sys
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache, lru_cache
from threading import RLock
from typing import TypeVar

from threadpoolctl import ThreadpoolController  # type: ignore[import-untyped] # ships no types

A = TypeVar("A")
R = TypeVar("R")

THREADS = 2  # that share a piece of work, unless a setting or the caller says otherwise


@cache
def worker_pool(threads: int) -> ThreadPoolExecutor:
    """Pool of that many threads in addition to the caller, shared by the whole process."""
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


class _BlasLimit:
    """The blocks that want one BLAS thread, and what restores the threads of before."""

    changing = RLock()  # re-entrant: garbage collection may end another block here
    wanted_by = 0
    restore: Callable[[], object]


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Limit BLAS to one thread in the whole process while a `with` block runs, in any thread.

    The threads of BLAS spin while they wait for one another: on a busy computer a decomposition of 30 ms takes half a
    second, and frames are lost. One thread also adds sums in a fixed order, so that results repeat.
    """
    with _BlasLimit.changing:
        if not _BlasLimit.wanted_by:
            limit = _libraries(len(sys.modules)).limit(limits=1, user_api="blas")
            _BlasLimit.restore = limit.restore_original_limits
        _BlasLimit.wanted_by += 1
    try:
        yield
    finally:
        with _BlasLimit.changing:
            _BlasLimit.wanted_by -= 1
            if not _BlasLimit.wanted_by:
                _BlasLimit.restore()


@lru_cache(maxsize=1)
def _libraries(_modules: int) -> ThreadpoolController:
    """The loaded libraries, which take a millisecond to find; more are loaded only with more modules."""
    return ThreadpoolController()
