"""Program libraries that a bench names: loading one runs its code, so each is confirmed once.

Their contents are compared with the confirmed ones when a bench is opened, and again directly before a device is.
"""

import json
import re
from contextlib import suppress
from dataclasses import dataclass
from hashlib import file_digest, sha256
from pathlib import Path

import platformdirs

from app.bench.config import Bench
from app.errors import InputError, RunError
from app.run_facts import write_record

_SETTINGS = ("library", "adapter_folder")  # of [camera] and [light]: paths of code
_LIBRARY = re.compile(r"(lib)?mmgr_dal_|.*\.(dll|so|dylib)(\.|$)", re.IGNORECASE)  # names of code in a folder
_confirmed: dict[str, str] = {}  # setting and contents, by this process


@dataclass(frozen=True, slots=True)
class Library:
    """A library, or a folder of them, that a bench names."""

    key: str  # of the bench, for example "camera.library"
    named: str

    def trust(self) -> None:
        """Remember that it may be loaded, until it changes."""
        path = Path(self.named).resolve()
        _confirmed[self.named] = _contents(path)
        with suppress(RunError):  # then it is asked for again
            write_record(_file(), {**_known(), str(path): _confirmed[self.named]})

    @property
    def is_trusted(self) -> bool:
        """True if it has not changed since it was confirmed."""
        path = Path(self.named).resolve()
        contents = _contents(path)
        if is_known := _known().get(str(path)) == contents:
            _confirmed[self.named] = contents
        return is_known


def named_libraries(bench: Bench) -> tuple[Library, ...]:
    """Return the libraries that a bench names, without reading them."""
    return tuple(
        Library(f"{section}.{key}", str(value))
        for section, settings in (("camera", bench.camera), ("light", bench.light))
        for key in _SETTINGS
        if (value := getattr(settings, key, ""))
    )


def unconfirmed(bench: Bench) -> tuple[Library, ...]:
    """Return the libraries of a bench that nobody has confirmed as they are."""
    return tuple(library for library in named_libraries(bench) if not library.is_trusted)


def check_unchanged(settings: object) -> None:
    """Raise `InputError` if a library has changed since this process confirmed it.

    A program that calls the Python interface confirms none: it has chosen them itself.
    """
    for key in _SETTINGS:
        named = str(getattr(settings, key, ""))
        if named in _confirmed and _confirmed[named] != _contents(Path(named).resolve()):
            raise InputError(f"{key} = {named} has changed since it was confirmed: open the bench again to be asked")


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
    """Return a digest of a library, or of all in a folder; empty if there is none."""
    try:
        if path.is_file():
            return _digest(path)
        files = sorted(each for each in path.iterdir() if _LIBRARY.match(each.name) and each.is_file())
        return sha256(repr([(each.name, _digest(each)) for each in files]).encode()).hexdigest()
    except OSError:  # a name that the system looks up
        return ""


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return file_digest(file, "sha256").hexdigest()
