"""Memory that a closed bench has used: caches of its results, and its release."""

import ctypes
import gc
import sys
from collections.abc import Callable
from functools import lru_cache
from typing import TypeVar

F = TypeVar("F", bound=Callable[..., object])

_forget: list[Callable[[], None]] = []


def kept_for_bench(maxsize: int) -> Callable[[F], F]:
    """Cache the last results of a function as `lru_cache` does, until `release_memory`."""

    def decorate(function: F) -> F:
        cached = lru_cache(maxsize)(function)
        _forget.append(cached.cache_clear)
        return cached  # type: ignore[return-value] # it is called in the same way

    return decorate


def release_memory() -> None:
    """Free what nobody refers to any more, and return it to the system; takes some tenths of a second.

    An acquisition refers to itself, and Python seldom looks for such objects. The C library of Linux keeps freed memory
    that lies between pieces in use, and needs ever more.
    """
    for forget in _forget:
        forget()
    gc.collect()
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # only the GNU library has it
        if trim is not None:
            trim(0)
