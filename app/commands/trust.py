"""Confirmation of program libraries that a bench names, because loading one runs its code."""

import json
import sys
from contextlib import suppress
from hashlib import sha256
from pathlib import Path

import platformdirs

from app.bench.config import Bench
from app.errors import InputError, RunError
from app.run_facts import write_record

_SETTINGS = ("library", "adapter_folder")  # of [camera] and [light]: paths of code


def confirm_libraries(bench: Bench, *, trust: bool) -> None:
    """Ask once for each library that a bench names whether it may be loaded; with `trust`, remember it without asking.

    A changed library is asked for again. `InputError` if it is refused, or no terminal is attached.
    """
    for section, settings in (("camera", bench.camera), ("light", bench.light)):
        for key in _SETTINGS:
            if named := getattr(settings, key, ""):
                _confirm(f"{section}.{key}", str(named), trust=trust)


def _confirm(key: str, named: str, *, trust: bool) -> None:
    path = Path(named).resolve()
    known, contents = _known(), _contents(path)
    if known.get(str(path)) == contents:
        return
    if not trust:
        if not sys.stdin.isatty():
            raise InputError(
                f"{key} = {named} would run code: add --trust-library once if you trust it, or start the command in a"
                " terminal to be asked"
            )
        sys.stderr.write(f"the bench runs code: {key} = {named}\nType yes if you trust it: ")
        if sys.stdin.readline().strip().lower() != "yes":
            raise InputError(f"{key} = {named} is not trusted: change the bench")
    with suppress(RunError):  # then it is asked for again
        write_record(_file(), {**known, str(path): contents})


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
