"""Program libraries that a bench names: loading one runs its code, so each is confirmed once."""

import json
from contextlib import suppress
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

import platformdirs

from app.bench.config import Bench
from app.errors import RunError
from app.run_facts import write_record

_SETTINGS = ("library", "adapter_folder")  # of [camera] and [light]: paths of code


@dataclass(frozen=True, slots=True)
class Library:
    """A library, or a folder of them, that a bench names."""

    key: str  # of the bench, for example "camera.library"
    named: str

    def trust(self) -> None:
        """Remember that it may be loaded, until it changes."""
        path = Path(self.named).resolve()
        with suppress(RunError):  # then it is asked for again
            write_record(_file(), {**_known(), str(path): _contents(path)})

    @property
    def is_trusted(self) -> bool:
        """True if it has not changed since it was confirmed."""
        path = Path(self.named).resolve()
        return _known().get(str(path)) == _contents(path)


def unconfirmed(bench: Bench) -> tuple[Library, ...]:
    """Return the libraries of a bench that nobody has confirmed as they are."""
    named = (
        Library(f"{section}.{key}", str(value))
        for section, settings in (("camera", bench.camera), ("light", bench.light))
        for key in _SETTINGS
        if (value := getattr(settings, key, ""))
    )
    return tuple(library for library in named if not library.is_trusted)


def _file() -> Path:
    return Path(platformdirs.user_config_dir("svwfs")) / "trusted_libraries.json"


def _known() -> dict[str, str]:
    """Path and contents of the trusted libraries."""
    try:
        known = json.loads(_file().read_text("utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return known if isinstance(known, dict) else {}


def _contents(path: Path) -> str:
    """Return a digest of a library, or of the names and dates in a folder of many; empty if there is none."""
    try:
        if path.is_dir():
            files = sorted((each.name, each.stat().st_size, each.stat().st_mtime_ns) for each in path.iterdir())
            return sha256(repr(files).encode(errors="replace")).hexdigest()
        return sha256(path.read_bytes()).hexdigest()
    except OSError:  # a name that the system looks up
        return ""
