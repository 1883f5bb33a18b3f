"""Memory that a closed bench has used: caches of its results, and its release."""

import ctypes
import gc
import sys
from collections.abc import Callable
from functools import lru_cache
from typing import Any

_caches: list[Any] = []


def kept_for_bench(maxsize: int) -> Callable[[Any], Any]:
    """Cache the last results of a function as `lru_cache` does, until `release_memory`."""

    def decorate(function: Callable[..., Any]) -> Any:
        _caches.append(lru_cache(maxsize)(function))
        return _caches[-1]

    return decorate


def release_memory() -> None:
    """Free what nobody refers to any more, and return it to the system; takes some tenths of a second.

    An acquisition refers to itself, and Python seldom looks for such objects. The GNU library keeps freed memory that
    lies between pieces in use.
    """
    for cached in _caches:
        cached.cache_clear()
    gc.collect()
    if sys.platform == "linux" and (trim := getattr(ctypes.CDLL(None), "malloc_trim", None)):
        trim(0)
