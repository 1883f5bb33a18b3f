"""What Windows does and Linux does not, for tests on Linux."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest


def open_files_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    """Refuse to rename, replace or delete a file that this process has open or mapped; Windows does so itself."""
    if sys.platform == "win32":
        return
    replace, unlink = Path.replace, Path.unlink

    def check(*paths: Path) -> None:
        opened = set[str]()
        for descriptor in Path("/proc/self/fd").iterdir():
            with suppress(FileNotFoundError):  # the folder itself
                opened.add(str(descriptor.readlink()))
        for path in paths:
            if os.path.realpath(path) in opened:
                raise PermissionError(13, "used by another process", str(path))

    def checked_replace(source: Path, target: Path) -> Path:
        check(source, target)
        return replace(source, target)

    def checked_unlink(path: Path, *, missing_ok: bool = False) -> None:
        check(path)
        unlink(path, missing_ok)

    monkeypatch.setattr(Path, "replace", checked_replace)
    monkeypatch.setattr(Path, "unlink", checked_unlink)


def refusing(number: int) -> Callable[..., int]:
    """Return a function that fails with an error number, in place of `os.open`."""

    def refuse(path: Path, *_: object) -> int:
        raise OSError(number, os.strerror(number), str(path))

    return refuse
