"""Numba compilation that releases the interpreter lock and caches on disk."""

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, ParamSpec, TypeVar, cast

import numba

P = ParamSpec("P")
R = TypeVar("R")

FAST_MATH = ("contract", "reassoc", "nsz")  # what the compiler may change of floating-point operations

_PACKAGE = Path(__file__).resolve().parents[1]
_SOURCES = hashlib.sha256(b"".join(path.read_bytes() for path in sorted(_PACKAGE.rglob("*.py")))).hexdigest()


def compiled(function: Callable[P, R]) -> Callable[P, R]:
    """Compile with Numba on the first call; a typed wrapper of the untyped decorator."""
    # A function that is called, not inlined, may be another process's copy of it, which rounds differently: results
    # would depend on what was compiled and what came from the cache.
    options: dict[str, Any] = {"nogil": True, "forceinline": True, "error_model": "numpy"}
    options["fastmath"] = set(FAST_MATH)
    try:
        dispatcher: Any = numba.njit(cache=True, **options)(function)
    except RuntimeError:  # no folder for the cache can be written
        return cast("Callable[P, R]", numba.njit(**options)(function))
    # Numba checks only the function's file for changes, but inlines functions and constants of other files. Its version
    # is checked before the rest of the cache is read, which may name classes that no longer exist.
    dispatcher._cache._cache_file._version = f"{numba.__version__} {_SOURCES}"  # noqa: SLF001 - there is no public way
    return cast("Callable[P, R]", dispatcher)
