"""Persistent worker threads, and a limit on the threads of BLAS."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from functools import cache

from threadpoolctl import threadpool_limits  # type: ignore[import-untyped] # ships no types

from reconstruction.runtime.process_setting import ProcessSetting


@cache
def worker_pool(threads: int) -> ThreadPoolExecutor:
    """Pool of that many threads besides the caller, shared by the whole process."""
    return ThreadPoolExecutor(threads, thread_name_prefix="reconstruction")


if hasattr(os, "register_at_fork"):  # a forked process inherits the pools, but not their threads
    os.register_at_fork(after_in_child=worker_pool.cache_clear)


def one_blas_thread() -> AbstractContextManager[None]:
    """Limit BLAS to one thread in the whole process inside a `with` block.

    The threads of BLAS spin while they wait for one another: on a busy computer a decomposition of 30 ms takes half a
    second, and frames are lost. One thread also adds sums in a fixed order, so that results repeat.
    """
    return _one_blas_thread.wanted()


def _limit_blas() -> Callable[[], object]:
    limit: Callable[[], object] = threadpool_limits(1, user_api="blas").restore_original_limits
    return limit


_one_blas_thread = ProcessSetting(_limit_blas)
