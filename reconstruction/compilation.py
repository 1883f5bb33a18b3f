"""Numba, as this project uses it: compiled code lets go of the interpreter's lock and is kept on disk."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, ParamSpec, TypeVar, cast

import numba

P = ParamSpec("P")
R = TypeVar("R")

_COMPILED_FILES = (
    "kernel",
    "alignment",
    "search",
    "lenslet_fits",
    "fit_errors",
    "gauss_newton",
    "lenslet_weights",
    "evidence",
    "prefilter",
    "whitening",  # none of it is compiled, but a number of it is compiled in
)
_SOURCES = hashlib.sha256(
    b"".join(Path(__file__).with_name(f"{name}.py").read_bytes() for name in _COMPILED_FILES)
).hexdigest()


def compiled(function: Callable[P, R]) -> Callable[P, R]:
    """Compile with Numba on the first call and keep the result on disk; a typed face for an untyped decorator."""
    dispatcher: Any = numba.njit(nogil=True, cache=True, fastmath={"contract", "reassoc", "nsz"}, error_model="numpy")(
        function
    )
    # Numba looks for changes in the function's own file alone, but keeps with it what it calls in the others.
    dispatcher._cache._cache_file._source_stamp = _SOURCES  # noqa: SLF001 - there is no public way to say so
    return cast("Callable[P, R]", dispatcher)
