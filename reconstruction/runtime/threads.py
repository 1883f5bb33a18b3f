"""Threads that stay, so that a frame need not make any; and how many of them BLAS may have."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from functools import cache

from threadpoolctl import threadpool_limits  # type: ignore[import-untyped] # ships no types

from reconstruction.runtime.process_setting import ProcessSetting


@cache
def worker_pool(threads: int) -> ThreadPoolExecutor:
    """So many threads beside the one that asks, the same for the whole program."""
    return ThreadPoolExecutor(threads, thread_name_prefix="reconstruction")


def one_blas_thread() -> AbstractContextManager[None]:
    """Let BLAS work in one thread while a `with` lasts, in all of the process: live, and wherever live is repeated.

    Its own threads wait for one another at full speed: on a busy computer that takes half a second for a decomposition
    of 30 ms, and frames are lost. And in one thread sums are always added in the same order. Several threads may ask
    for it; whoever is the last to leave, and nobody before, takes the limit away.
    """
    return _one_blas_thread.wanted()


def _limit_blas() -> Callable[[], object]:
    limit: Callable[[], object] = threadpool_limits(1, user_api="blas").restore_original_limits
    return limit


_one_blas_thread = ProcessSetting(_limit_blas)
