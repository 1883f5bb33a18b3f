"""State of a process: alive, frozen or gone."""

import subprocess
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Self, TypeAlias

Condition: TypeAlias = Literal["alive", "frozen", "gone"]


@dataclass(frozen=True, slots=True)
class ProcessState:
    """A process of an instrument, by its name and id."""

    name: Literal["instrument", "guardian", "finder"]
    pid: int
    condition: Condition

    @classmethod
    def of(cls, name: Literal["guardian", "finder"], process: subprocess.Popen[bytes]) -> Self:
        """Look at a process that this one has started; only Linux tells that it was stopped."""
        is_gone, is_stopped = process.poll() is not None, stat_of(process.pid)[:1] in (["T"], ["t"])
        return cls(name, process.pid, "gone" if is_gone else "frozen" if is_stopped else "alive")


def stat_of(process: int) -> list[str]:
    """Return what Linux tells of a process, from its state on; else nothing."""
    with suppress(OSError):
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return []
