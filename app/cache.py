"""Caches of results in memory and on disk, and the release of memory."""

import atexit
import ctypes
import gc
import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import cache, wraps
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary
from zipfile import BadZipFile

import numpy as np
import platformdirs
from numpy.typing import NDArray

from app.errors import InputError, RunError
from app.files import atomic_write, check_writable
from reconstruction.arrays import reading_npy

_KEPT = 400  # results of one kind; a third of a gigabyte of images
_ARENA_MAX = -8  # of `mallopt` in the GNU library

Arrays = Mapping[str, NDArray[Any]]


@contextmanager
def loading() -> Iterator[None]:
    """Collect no garbage meanwhile, and never look again at what is there at the end: it would take 100 ms."""
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()


@cache
def cache_folder() -> Path:
    """Return the user's cache folder, or a temporary one for this run if that cannot be written."""
    folder = Path(platformdirs.user_cache_dir("svwfs"))
    try:
        folder.mkdir(parents=True, exist_ok=True)
        check_writable(folder)
    except (OSError, InputError):  # no home folder, or a read-only one
        pass
    else:
        return folder
    temporary = tempfile.mkdtemp(prefix="svwfs-")
    atexit.register(shutil.rmtree, temporary, ignore_errors=True)
    return Path(temporary)


def cached(kind: str, fingerprint: str, compute: Callable[[], Arrays]) -> Arrays:
    """Return the cached result of `compute`, or compute it; `fingerprint`, a file name, represents all its inputs."""
    path = cache_folder() / kind / f"{fingerprint}.npz"
    kept = _load(path)
    if kept is not None:
        return kept
    computed = compute()
    with suppress(RunError):  # a full disk only means that nothing is cached
        with atomic_write(path) as temporary:
            np.savez(temporary, allow_pickle=False, **computed)
        with suppress(OSError):  # one was removed by another process
            for old in sorted(path.parent.glob("*.npz"), key=lambda each: -each.stat().st_mtime)[_KEPT:]:
                old.unlink(missing_ok=True)
    return computed


def _load(path: Path) -> Arrays | None:
    try:
        with reading_npy(), path.open("rb") as file, np.load(file, allow_pickle=False) as kept:
            result = dict(kept)
        os.utime(path)  # least recently used results are removed first
    except (OSError, ValueError, EOFError, BadZipFile):  # missing or damaged
        return None
    return result


def kept_while_alive(maxsize: int) -> Callable[[Any], Any]:
    """Cache results for each of the last first arguments while these live; `lru_cache` would keep a closed bench."""

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        results: WeakKeyDictionary[Any, dict[tuple[Any, ...], Any]] = WeakKeyDictionary()

        @wraps(function)
        def kept(first: Any, *others: Any) -> Any:
            if first not in results and len(results) >= maxsize:
                results.clear()
            of_first = results.setdefault(first, {})
            if others not in of_first:
                of_first[others] = function(first, *others)
            return of_first[others]

        return kept

    return decorate


def share_memory_of_threads() -> None:
    """Let all later threads allocate from two places: of a place for each, most could never be returned."""
    if sys.platform == "linux" and (set_option := getattr(ctypes.CDLL(None), "mallopt", None)):
        set_option(_ARENA_MAX, 2)


def release_memory() -> None:
    """Free what nobody refers to any more, and return it to the system; takes some tenths of a second.

    An acquisition refers to itself, and Python seldom looks for such objects. The GNU library keeps freed memory
    that lies between pieces in use.
    """
    gc.unfreeze()
    gc.collect()
    gc.freeze()
    if sys.platform == "linux" and (trim := getattr(ctypes.CDLL(None), "malloc_trim", None)):
        trim(0)
