"""Bench files: where they are, their text, and the place of a fault in it."""

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from app.bench.presets import PRESETS
from app.errors import InputError
from app.files import check_readable, in_words
from app.run_facts import newer_version
from reconstruction.annotated_settings import SettingError

WRITTEN_BY_NEWER = "a newer svwfs, {}, wrote it: update svwfs to read it"
_HEADER = re.compile(r"\s*\[+\s*([\w.\-\s]+?)\s*\]+")
_KEY = re.compile(r"\s*([\w.\-]+)\s*=")
_AROUND = 2  # lines of an excerpt on both sides
_TOML_PLACE = re.compile(r"\(at (?:line (\d+), column \d+|end of document)\)")


class BenchError(InputError):
    """An invalid bench."""

    def __init__(self, sentence: str, line: int | None, fault: SettingError | None = None) -> None:
        """`line` counts from 1, None if no line is at fault; `fault` names the wrong setting."""
        super().__init__(sentence)
        self.line, self.fault = line, fault


@contextmanager
def written_by(source: object, software: object) -> Iterator[None]:
    """Name a newer svwfs, of version `software`, as the cause if a bench in a file cannot be read."""
    try:
        yield
    except BenchError as error:
        if newer := newer_version(software):
            raise InputError(f"{source}: {WRITTEN_BY_NEWER.format(newer)}") from error
        raise


def bench_file(source: str | Path) -> Path:
    """Return the file of a bench: a plain word is a preset, all else a path; `InputError` if there is no such bench."""
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


def line_of_syntax(text: str, sentence: str) -> int | None:
    """Return the line that an error of `tomllib` names."""
    place = _TOML_PLACE.search(sentence)
    if place is None:
        return None
    return int(place[1]) if place[1] else max(len(text.splitlines()), 1)


def line_of_setting(text: str, path: str) -> int | None:
    """Return the line of a setting, or else of its section, in a valid TOML text."""
    lines = dict(reversed(list(_settings(text))))  # the first line of each
    return next((lines[each] for each in (path, path.rpartition(".")[0]) if each in lines), None)


def _settings(text: str) -> Iterator[tuple[str, int]]:
    """Yield the dotted path of each header and key, with its line."""
    section = ""
    for number, line in enumerate(text.splitlines(), 1):
        if header := _HEADER.match(line):
            section = re.sub(r"\s", "", header[1])
            yield section, number
        elif key := _KEY.match(line):
            yield f"{section}.{key[1]}".strip("."), number


def faulty_lines(source: str, error: InputError) -> tuple[Path | None, int | None, tuple[tuple[int, str], ...]]:
    """Return file, faulty line and the lines around it of a bench that could not be read."""
    try:
        path = bench_file(source)
        line = error.line if isinstance(error, BenchError) else None
        return path, line, () if line is None else excerpt(read_bench_text(path), line)
    except InputError:
        return None, None, ()


def excerpt(text: str, line: int) -> tuple[tuple[int, str], ...]:
    """Return a line of a text and its neighbours, each with its number."""
    first = max(line - 1 - _AROUND, 0)
    return tuple(enumerate(text.splitlines()[first : line + _AROUND], first + 1))
