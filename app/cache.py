"""What took long to compute, kept on disk under everything it depends on."""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
import platformdirs
from numpy.typing import NDArray

from app.errors import RunError
from app.files import appearing_whole

_KEPT = 400  # results of one kind; of images, a third of a gigabyte

Arrays = Mapping[str, NDArray[Any]]


@cache
def cache_folder() -> Path:
    """Where what was computed is kept from one run to the next; for this run only, where nothing can be kept."""
    folder = Path(platformdirs.user_cache_dir("svwfs"))
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if os.access(folder, os.W_OK):
            return folder
    except OSError:  # no home, or one that cannot be written
        pass
    temporary = tempfile.mkdtemp(prefix="svwfs-")
    atexit.register(shutil.rmtree, temporary, ignore_errors=True)
    return Path(temporary)


def remembered(kind: str, fingerprint: str, compute: Callable[[], Arrays]) -> Arrays:
    """Return what `compute` makes, or has made before: the last 400 results of one kind are kept.

    `fingerprint`, the name of a file, stands for all that the result depends on.
    """
    path = cache_folder() / kind / f"{fingerprint}.npz"
    kept = _load(path)
    if kept is not None:
        return kept
    computed = compute()
    with suppress(RunError):  # a full disk keeps nothing, and that is all
        with appearing_whole(path) as temporary:
            np.savez(temporary, allow_pickle=False, **computed)
        _keep_newest(path.parent)
    return computed


def _load(path: Path) -> Arrays | None:
    try:
        with np.load(path, allow_pickle=False) as kept:
            result = dict(kept)
        os.utime(path)  # used now: the last to be cleared away
    except (OSError, ValueError, EOFError, BadZipFile):  # not there, or not whole: compute it
        return None
    return result


def _keep_newest(folder: Path) -> None:
    for path in sorted(folder.glob("*.npz"), key=_age)[_KEPT:]:
        path.unlink(missing_ok=True)


def _age(path: Path) -> float:
    try:
        return -path.stat().st_mtime
    except OSError:  # another process cleared it away
        return 0.0
