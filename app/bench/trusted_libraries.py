"""Program libraries that a bench names: loading one runs its code, so each path is confirmed once."""

import json
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import platformdirs

from app.bench.config import Bench
from app.errors import RunError
from app.files import write_whole

_SETTINGS = ("library", "adapter_folder")  # of [camera] and [light]: paths of code


class Library(NamedTuple):
    """A library, or a folder of them, that a bench names."""

    key: str  # of the bench, for example "camera.library"
    named: str


def named_libraries(bench: Bench) -> tuple[Library, ...]:
    """Return the libraries that a bench names, without reading a file."""
    return tuple(
        Library(f"{section}.{key}", str(value))
        for section, settings in (("camera", bench.camera), ("light", bench.light))
        for key in _SETTINGS
        if (value := getattr(settings, key, ""))
    )


def unconfirmed(bench: Bench) -> tuple[Library, ...]:
    """Return the libraries of a bench whose paths nobody has confirmed."""
    known = _known()
    return tuple(library for library in named_libraries(bench) if _path(library) not in known)


def trust(libraries: Iterable[Library]) -> None:
    """Remember that these libraries may be loaded."""
    with suppress(RunError):  # then they are asked for again
        write_whole(_file(), json.dumps(sorted(_known() | {*map(_path, libraries)}), indent=2) + "\n")


def _path(library: Library) -> str:
    return str(Path(library.named).resolve())


def _file() -> Path:
    return Path(platformdirs.user_config_dir("svwfs")) / "trusted_libraries.json"


def _known() -> set[str]:
    """Paths of the trusted libraries."""
    try:
        return set(json.loads(_file().read_text("utf-8")))
    except (OSError, ValueError, TypeError, RecursionError):
        return set()
