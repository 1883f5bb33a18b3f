"""Facts stored with every run: time, software, computer, and stage times."""

import json
import math
import os
import platform
import re
import sys
from collections.abc import Mapping
from dataclasses import asdict
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from app.files import write_whole
from app.timing import STAGES, StageTimes, TimedStage

_LIBRARIES = ("svwfs", "numpy", "scipy", "numba", "opencv-python-headless", "PyQt6", "pyqtgraph")
_CPU = Path("/proc/cpuinfo")
_VERSION_PART = re.compile(r"\b\d{1,9}\b")
MAIN = "import svwfs; svwfs.main()"  # what a Python runs to be this svwfs


def now() -> str:
    """Current time, UTC, as ISO 8601."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


def software_facts() -> dict[str, Any]:
    """Versions of the software, and the computer."""
    return {"versions": versions("zarr"), "machine": machine_facts()}


def command_line(*arguments: str | Path) -> tuple[str, list[str]]:
    """Return program and arguments of a command of this svwfs, whatever lies in the working directory."""
    return sys.executable, ["-P", "-c", MAIN, *map(str, arguments)]


def machine_facts() -> dict[str, str | int]:
    """The properties of this computer that determine its speed."""
    return {"system": f"{platform.system()} {platform.machine()}", "cores": os.cpu_count() or 1, "processor": _cpu()}


def versions(*more: str) -> dict[str, str]:
    """Versions of Python, of the main libraries, and of the packages `more` that are installed."""
    installed = {"python": platform.python_version()}
    for name in (*_LIBRARIES, *more):
        try:
            installed[name] = version(name)
        except PackageNotFoundError:
            continue
    return installed


def newer_version(writer: object) -> str:
    """Return the version of a writer, as "svwfs 0.3.0" or "0.3.0", if it is newer than this; else ""."""
    theirs, ours = ([int(part) for part in _VERSION_PART.findall(str(each))] for each in (writer, version("svwfs")))
    return str(writer).removeprefix("svwfs ") if theirs > ours else ""


def timing_facts(times: Mapping[TimedStage, StageTimes]) -> dict[str, dict[str, float | None]]:
    """Count, median, 99th percentile and maximum (s) of every stage; None if nothing was timed."""
    return {
        stage: {name: None if math.isnan(value) else value for name, value in asdict(times[stage]).items()}
        for stage in STAGES
    }


def write_record(path: Path, record: Mapping[str, Any]) -> None:
    """Write a record as JSON, atomically."""
    write_whole(path, json.dumps(record, indent=2) + "\n")


def _cpu() -> str:
    try:
        lines = _CPU.read_text().splitlines()
    except OSError:
        return platform.processor()
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), "")
