"""What computer and which libraries a time was measured with."""

from __future__ import annotations

import os
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

_LIBRARIES = ("svwfs", "numpy", "scipy", "numba", "opencv-python-headless", "PyQt6", "pyqtgraph")
_CPU = Path("/proc/cpuinfo")


def machine_facts() -> dict[str, str | int]:
    """The computer, as far as it matters for speed."""
    return {"system": f"{platform.system()} {platform.machine()}", "cores": os.cpu_count() or 1, "processor": _cpu()}


def versions(*more: str) -> dict[str, str]:
    """Versions of Python and of the libraries that work is done with, and of some `more` packages if installed."""
    found = {"python": platform.python_version()}
    for name in (*_LIBRARIES, *more):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def _cpu() -> str:
    try:
        lines = _CPU.read_text().splitlines()
    except OSError:
        return platform.processor()
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), "")
