"""A bench with a DCAM camera and a DC4100 whose stand-ins the tests have, and the processes of an instrument."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from support.dcam_tools import built
from support.paths import FOREIGN_FRAMES


def children(pid: int) -> set[int]:
    """The processes that all threads of a process have started, and that live."""
    found = set[int]()
    for task in Path(f"/proc/{pid}/task").iterdir():
        with suppress(FileNotFoundError, ProcessLookupError):  # of a thread that has ended meanwhile
            found |= {int(child) for child in (task / "children").read_text().split()}
    return {child for child in found if not is_gone(child)}


def is_gone(pid: int) -> bool:
    """True if a process has ended, also if its parent has not noticed yet."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except (FileNotFoundError, ProcessLookupError):  # before and while it is read
        return True


def bench_toml(port: str, folder: Path) -> Path:
    path = folder / "bench.toml"
    path.write_text(
        (FOREIGN_FRAMES / "bench.toml").read_text()
        + f"""
[camera]
driver = "dcam"
library = '{built()}'
exposure_s = 0.02

[light]
driver = "thorlabs_dc4100"
port = "{port}"
current_a = 0.1
"""
    )
    return path
