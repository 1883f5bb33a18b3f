"""Numba, as this project uses it: compiled code lets go of the interpreter's lock and is kept on disk."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, ParamSpec, TypeVar, cast

import numba

P = ParamSpec("P")
R = TypeVar("R")

_PACKAGE = Path(__file__).resolve().parents[1]
_SOURCES = hashlib.sha256(b"".join(path.read_bytes() for path in sorted(_PACKAGE.rglob("*.py")))).hexdigest()


def compiled(function: Callable[P, R]) -> Callable[P, R]:
    """Compile with Numba on the first call and keep the result on disk; a typed face for an untyped decorator."""
    dispatcher: Any = numba.njit(nogil=True, cache=True, fastmath={"contract", "reassoc", "nsz"}, error_model="numpy")(
        function
    )
    # Numba checks only the function's own file for changes, but inlines functions and constants from others.
    dispatcher._cache._cache_file._source_stamp = _SOURCES  # noqa: SLF001 - there is no public way to say so
    return cast("Callable[P, R]", dispatcher)
