"""The folder in which a recording begins: one that holds none, or a new one beside those that are there."""

from __future__ import annotations

import os
from itertools import chain, count
from pathlib import Path

from app.errors import InputError
from app.files import nearest_existing
from app.recording.layout import FRAMES, RUN, STORE


def check_free(folder: Path) -> None:
    """Raise `InputError` when no recording can begin in the folder: it holds one, or it can be no folder for one."""
    try:
        for name in (RUN, FRAMES, STORE):
            if (folder / name).exists():
                raise InputError(f"{folder}: holds a recording already: {name}")
        _check_place(folder)
    except OSError as error:
        raise _unusable(folder, error) from error


def new_folder(wanted: Path) -> Path:
    """Make the folder and return it; with -2, -3, ... after its name where that one is there already.

    Each who asks gets one of its own, also of two programs that ask at once. `InputError` when none can be made.
    """
    try:
        _check_place(wanted.parent)
        wanted.parent.mkdir(parents=True, exist_ok=True)
        numbered = (wanted.with_name(f"{wanted.name}-{number}") for number in count(2))
        return next(folder for folder in chain([wanted], numbered) if _is_made(folder))
    except OSError as error:
        raise _unusable(wanted, error) from error


def _is_made(folder: Path) -> bool:
    """Make a folder; False where there is something already."""
    try:
        folder.mkdir()
    except FileExistsError:
        return False
    return True


def _check_place(folder: Path) -> None:
    """Raise `InputError` when it is no folder, or cannot be made one."""
    there = nearest_existing(folder)
    if not there.is_dir():
        raise InputError(f"{there}: is no folder")
    if not os.access(there, os.W_OK | os.X_OK):
        raise InputError(f"{there}: nothing may be written there")


def _unusable(folder: Path, error: OSError) -> InputError:
    return InputError(f"{folder}: cannot be used: {error.strerror or error}")
