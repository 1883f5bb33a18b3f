"""Threads that stay, so that a frame need not make any."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import cache


@cache
def worker_pool(threads: int) -> ThreadPoolExecutor:
    """So many threads beside the one that asks, the same for the whole program."""
    return ThreadPoolExecutor(threads, thread_name_prefix="reconstruction")
