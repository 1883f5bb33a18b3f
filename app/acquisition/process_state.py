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
        is_gone = process.poll() is not None
        return cls(name, process.pid, "gone" if is_gone else "frozen" if _is_stopped(process.pid) else "alive")


def _is_stopped(process: int) -> bool:
    with suppress(OSError):
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] in {"T", "t"}
    return False
