"""Waiting in tests: a stalled computer does no harm, and hanging fails."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from subprocess import PIPE

import pytest

from support import patience
from support.paths import TESTS
from support.patience import HANG_S, own_time, wait_until

# Prints the own time that it waited for a line.
WAITING = """
from support.patience import own_time
with own_time() as elapsed_s:
    print("begun", flush=True)
    input()
    print(elapsed_s())
"""


def test_waiting_in_vain_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(patience, "HANG_S", 0.05)
    with pytest.raises(AssertionError, match=r"in 0\.05 s"):
        wait_until(lambda: False)


def test_own_time_is_at_most_real_time() -> None:
    began_s = time.monotonic()
    with own_time() as elapsed_s:
        wait_until(lambda: elapsed_s() > 0.3)
        assert elapsed_s() <= time.monotonic() - began_s


def test_own_time_stops_with_the_program() -> None:
    environment = os.environ | {"PYTHONPATH": str(TESTS)}
    command = [sys.executable, "-c", WAITING]
    began_s = time.monotonic()
    with subprocess.Popen(command, stdin=PIPE, stdout=PIPE, text=True, env=environment) as program:  # noqa: S603 - ours
        assert program.stdout is not None
        assert program.stdout.readline() == "begun\n"
        program.send_signal(signal.SIGSTOP)
        stopped_s = time.monotonic()
        time.sleep(2.0)
        stopped_s = time.monotonic() - stopped_s
        program.send_signal(signal.SIGCONT)
        told, _ = program.communicate("\n", timeout=HANG_S)
    assert float(told) < time.monotonic() - began_s - stopped_s
