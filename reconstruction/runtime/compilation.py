"""Numba compilation that releases the interpreter lock and caches on disk."""

import hashlib
import re
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, ParamSpec, TypeVar, cast

from reconstruction.runtime.compiler import numba

P = ParamSpec("P")
R = TypeVar("R")

FAST_MATH = ("contract", "reassoc", "nsz")  # what the compiler may change of floating-point operations

_PACKAGE = Path(__file__).resolve().parents[1]
_IMPORTS = re.compile(rf"^from ({_PACKAGE.name}[\w.]*) import (\([^)]*\)|.*)", re.MULTILINE)


def compiled(function: Callable[P, R]) -> Callable[P, R]:
    """Compile with Numba on the first call; a typed wrapper of the untyped decorator."""
    return _compiled(function, for_python=True)


def inlined(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a function that only compiled ones call, without what converts Python's arguments."""
    return _compiled(function, for_python=False)


def _compiled(function: Callable[P, R], *, for_python: bool) -> Callable[P, R]:
    # A function that is called, not inlined, may be another process's copy of it, which rounds differently: results
    # would depend on what was compiled and what came from the cache.
    options: dict[str, Any] = {"nogil": True, "forceinline": True, "error_model": "numpy"}
    # No kernel allocates arrays: those of its arguments need not be counted, which takes a fifth of a fit's time.
    options["_nrt"], options["no_cpython_wrapper"] = False, not for_python
    options["fastmath"] = set(FAST_MATH)
    try:
        dispatcher: Any = numba.njit(cache=True, **options)(function)
    except RuntimeError:  # no folder for the cache can be written
        return cast("Callable[P, R]", numba.njit(**options)(function))
    # Numba checks only the function's file for changes, but inlines functions and constants of other files. Its version
    # is checked before the rest of the cache is read, which may name classes that no longer exist.
    sources = _digest(Path(function.__code__.co_filename).resolve())
    dispatcher._cache._cache_file._version = f"{numba.__version__} {sources}"  # noqa: SLF001 - there is no public way
    return cast("Callable[P, R]", dispatcher)


@cache
def _digest(file: Path) -> str:
    """Hash of a file and of all files of this package that it imports, directly or through others."""
    waiting, read = [file], dict[Path, bytes]()
    while waiting:
        path = waiting.pop()
        if path not in read and path.is_file():
            read[path] = path.read_bytes()
            waiting += _imported(path)
    return hashlib.sha256(b"".join(read[path] for path in sorted(read))).hexdigest()


@cache
def _imported(path: Path) -> tuple[Path, ...]:
    """Files that a file may import from this package; names that are no modules have none."""
    found = list[Path]()
    for module, names in _IMPORTS.findall(path.read_text("utf-8")):
        place = _PACKAGE.parent.joinpath(*module.split("."))
        found += [place.with_suffix(".py"), place / "__init__.py"]
        found += [place / f"{name}.py" for name in re.findall(r"\w+", names)]
    return tuple(found)
