"""A mark on a file that it is being written; it goes with the program that made it, however that ends."""

from __future__ import annotations

import sys
from typing import IO

from app.errors import InputError


def lock(file: IO[bytes]) -> None:
    """Mark an open file; `InputError` when another program, or another part of this one, has marked it."""
    if sys.platform == "win32":  # has no such mark that would let others read
        return
    import fcntl  # noqa: PLC0415 - not there on Windows

    try:
        fcntl.flock(file.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise InputError(f"{file.name}: is still being recorded") from error
