"""The error of an invalid bench, with its place in the file."""

import re
from collections.abc import Iterator

from app.errors import InputError

_HEADER = re.compile(r"\s*\[+\s*([\w.\-\s]+?)\s*\]+")
_KEY = re.compile(r"\s*([\w.\-]+)\s*=")
_TOML_PLACE = re.compile(r"\(at (?:line (\d+), column \d+|end of document)\)")


class BenchError(InputError):
    """An invalid bench; `line` counts from 1 and is None if the fault lies at no line of the file."""

    def __init__(self, sentence: str, line: int | None) -> None:
        super().__init__(sentence)
        self.line = line


def line_of_syntax(text: str, sentence: str) -> int | None:
    """Return the line that an error of `tomllib` names."""
    place = _TOML_PLACE.search(sentence)
    if place is None:
        return None
    return int(place[1]) if place[1] else max(len(text.splitlines()), 1)


def line_of_setting(text: str, section: str, sentence: str) -> int | None:
    """Return the line of a faulty setting of a valid TOML text: of its key, or else of its section.

    `section` is the dotted path of a section or a key. A `sentence` about a section begins with "unknown key" and the
    key's name, or with the name alone.
    """
    words = sentence.removeprefix("unknown key ").split(maxsplit=1)
    named = words[0].strip(",;:") if words else ""
    lines = dict(reversed(list(_settings(text))))  # the first line of each
    paths = (f"{section}.{named}".strip("."), section, section.rpartition(".")[0], named.rpartition(".")[0])
    return next((lines[path] for path in paths if path in lines), None)


def _settings(text: str) -> Iterator[tuple[str, int]]:
    """Yield the dotted path of each header and key, with its line."""
    section = ""
    for number, line in enumerate(text.splitlines(), 1):
        if header := _HEADER.match(line):
            section = re.sub(r"\s", "", header[1])
            yield section, number
        elif key := _KEY.match(line):
            yield f"{section}.{key[1]}".strip("."), number


def excerpt(text: str, line: int, around: int = 2) -> tuple[tuple[int, str], ...]:
    """Return a line of a text and its neighbours, each with its number."""
    first = max(line - 1 - around, 0)
    return tuple(enumerate(text.splitlines()[first : line + around], first + 1))
