"""Bench files: a preset by its name, any other file by its path."""

import os
from pathlib import Path

from app.bench.presets import PRESETS
from app.errors import InputError
from app.files import check_readable, in_words


def bench_file(source: str | Path) -> Path:
    """Return the file of a bench: a plain word is a preset, a name with a slash or a suffix is a path.

    So nothing in the working directory takes the place of a preset. `InputError` if there is no such bench.
    """
    path, name = Path(source), str(source)
    known = f"give a bench TOML or a preset ({', '.join(PRESETS)})"
    try:
        is_there = os.path.lexists(path)
    except ValueError as error:  # a null character
        raise InputError(f"{source!r}: not a file name; {known}") from error
    if path.name != name or path.suffix:
        if not is_there:
            raise InputError(f"{name}: no such file; {known}")
        return path
    if name in PRESETS:
        return PRESETS[name]
    raise InputError(f"{name}: no such preset; {known}" + f", or the file as ./{name}" * is_there)


def read_bench_text(path: Path) -> str:
    """Return the text of a bench file; `InputError` if it cannot be read."""
    check_readable(path)
    try:
        return path.read_text("utf-8-sig")  # Notepad on Windows writes a byte order mark
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not a text file") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {in_words(error)}") from error
