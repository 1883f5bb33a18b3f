"""Numba's compiler with a type: its own decorators have none that strict checking accepts."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

_Function = TypeVar("_Function", bound=Callable[..., Any])


def compiled(function: _Function) -> _Function:
    """Compile on first call, to run free of the interpreter's lock; the result is kept on disk for the next process."""
    return cast("_Function", numba.njit(nogil=True, fastmath=True, cache=True)(function))
