"""Child processes: a request to end reaches them, and what ended them is known."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest
from support.patience import HANG_S, wait_until

from reconstruction.runtime.child_process import Child, ask_to_end, crash_of, start_child

_FINISHES = """
import signal, sys, time
signal.signal(signal.SIGTERM, lambda *_: sys.exit(3))
print("ready", flush=True)
while True:
    time.sleep(0.02)
"""
_CONSOLE = """
import ctypes
programs = (ctypes.c_uint * 8)()
print(ctypes.windll.kernel32.GetConsoleProcessList(programs, 8), flush=True)
"""


def test_child_that_is_asked_to_end_may_finish_its_work(tmp_path: Path) -> None:
    with (tmp_path / "log").open("wb") as log, start_child(_FINISHES, output=log) as child:
        wait_until(lambda: b"ready" in (tmp_path / "log").read_bytes())
        ask_to_end(child)
        assert child.wait(HANG_S) == 3


@pytest.mark.skipif(sys.platform != "win32", reason="only there a closed console ends those that are attached to it")
def test_child_has_a_console_of_its_own() -> None:
    with start_child(_CONSOLE) as child:
        assert child.stdout is not None
        assert int(child.stdout.readline()) == 1
    assert subprocess.run([sys.executable, "-c", _CONSOLE], capture_output=True, check=True).stdout.strip() != b"1"  # noqa: S603 - this interpreter


@pytest.mark.parametrize(
    ("code", "says"),
    [
        (None, ""),
        (0, ""),
        (130, ""),
        pytest.param(-9, "was ended by SIGKILL", marks=pytest.mark.posix),
        (0xC0000005, "crashed with the Windows error 0xc0000005"),
    ],
)
def test_crash_is_known_by_the_exit_code(code: int | None, says: str) -> None:
    assert crash_of(cast("Child", SimpleNamespace(returncode=code))) == says
