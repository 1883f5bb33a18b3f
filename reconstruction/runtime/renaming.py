"""Renaming of files that another program may hold for a moment."""

import sys
import time
from pathlib import Path

_HELD_S = 2.0


def rename(source: Path, target: Path) -> None:
    """Rename a file or folder; for two seconds again on Windows, where a virus scanner may prevent it."""
    until_s = time.monotonic() + _HELD_S
    while True:
        try:
            source.replace(target)
        except PermissionError:
            if sys.platform != "win32" or time.monotonic() > until_s:
                raise
            time.sleep(0.01)
        else:
            return
