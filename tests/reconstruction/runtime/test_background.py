"""Background processes: they answer, and none outlives its parent or keeps it waiting."""

from __future__ import annotations

import os
import stat
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from support.paths import ROOT
from support.patience import wait_until

from reconstruction.runtime.background import BackgroundProcess

_PLACES = [str(Path(__file__).parent), str(ROOT / "tests")]
_PARENT = """
import time
from reconstruction.runtime.background import BackgroundProcess
from test_background import square
process = BackgroundProcess(square)
process.send(3)
print(process.process.pid, process.receive(), flush=True)
time.sleep(600)
"""


def square(messages: Iterator[Any], answer: Callable[[object], None]) -> None:
    """Work of the child."""
    for message in messages:
        print("what is printed is no answer", flush=True)  # noqa: T201 - the test is about it
        answer(message**2)


def standard_input(messages: Iterator[Any], answer: Callable[[object], None]) -> None:
    """Look at the standard input while a thread of the child reads the pipe."""
    for _ in messages:
        answer(stat.S_ISFIFO(os.fstat(0).st_mode))


class Unreadable:
    """Cannot be read in the child."""

    def __reduce__(self) -> tuple[Callable[[str], int], tuple[str]]:
        return int, ("no number",)


@pytest.fixture(autouse=True)
def _finds_this_module(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(_PLACES))
    for work in (square, standard_input):
        monkeypatch.setattr(work, "__module__", "test_background")


def test_process_answers_at_low_priority(capfd: pytest.CaptureFixture[str]) -> None:
    with closing(BackgroundProcess(square)) as process:
        for number in (3, np.arange(1e6)):
            process.send(number)
            np.testing.assert_array_equal(process.receive(), number**2)
        if sys.platform != "win32":
            pid = process.process.pid
            assert os.getpriority(os.PRIO_PROCESS, pid) >= os.getpriority(os.PRIO_PROCESS, 0) + 5
            assert os.getsid(pid) == os.getsid(0)  # niceness counts only there
            assert os.getpgid(pid) != os.getpgid(0)  # Ctrl-C does not reach it
    assert capfd.readouterr().err.count("no answer") == 2


def test_pipe_is_no_standard_input() -> None:
    """NumPy asks about the standard input when it is imported; on Windows it would wait for the thread that reads."""
    with closing(BackgroundProcess(standard_input)) as process:
        process.send(None)
        assert process.receive() is False


@pytest.mark.parametrize("kills", [True, False], ids=["killed", "unreadable message"])
def test_end_of_the_process_wakes_its_parent(capfd: pytest.CaptureFixture[str], *, kills: bool) -> None:
    with closing(BackgroundProcess(square)) as process:
        if kills:
            process.kill()
        else:
            process.send(Unreadable())
        with pytest.raises(EOFError):
            process.receive()
    assert ("no number" in capfd.readouterr().err) != kills


def test_process_ends_with_a_killed_parent() -> None:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([*_PLACES, str(ROOT)])}
    parent = subprocess.Popen([sys.executable, "-c", _PARENT], stdout=subprocess.PIPE, env=environment)  # noqa: S603 - this interpreter
    with parent:
        assert parent.stdout is not None
        pid, answer = map(int, parent.stdout.readline().split())
        parent.kill()
    assert answer == 9
    wait_until(lambda: not psutil.pid_exists(pid))
