"""Numba's compiler, with types for strict checking."""

from collections.abc import Callable
from typing import Any, TypeVar, cast

from reconstruction.runtime.compiler import numba

_Function = TypeVar("_Function", bound=Callable[..., Any])


def compiled(function: _Function) -> _Function:
    """Compile on the first call, without the interpreter's lock, and cache the result on disk."""
    try:
        return cast("_Function", numba.njit(nogil=True, fastmath=True, error_model="numpy", cache=True)(function))
    except RuntimeError:  # no folder for the cache can be written
        return cast("_Function", numba.njit(nogil=True, fastmath=True, error_model="numpy")(function))
