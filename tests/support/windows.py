"""What Windows does and Linux does not, for tests on Linux."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest


def renaming_refuses_open_files(monkeypatch: pytest.MonkeyPatch) -> None:
    """Refuse to rename a file, or to replace one, that this process has open; Windows does so itself."""
    if sys.platform == "win32":
        return
    replace = Path.replace

    def refusing(source: Path, target: Path) -> Path:
        opened = set[str]()
        for descriptor in Path("/proc/self/fd").iterdir():
            with suppress(FileNotFoundError):  # the folder itself
                opened.add(str(descriptor.readlink()))
        for path in (source, target):
            if os.path.realpath(path) in opened:
                raise PermissionError(13, "used by another process", str(path))
        return replace(source, target)

    monkeypatch.setattr(Path, "replace", refusing)


def refusing(number: int) -> Callable[..., int]:
    """Return a function that fails with an error number, in place of `os.open`."""

    def refuse(path: Path, *_: object) -> int:
        raise OSError(number, os.strerror(number), str(path))

    return refuse
