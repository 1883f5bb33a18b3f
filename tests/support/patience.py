"""Waiting in tests that tolerates a slow, shared or stalled computer."""

from __future__ import annotations

import errno
import os
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Final

# Longer than compiling everything in three processes on two slow cores; with compiled code, 20 s will do.
HANG_S: Final = float(os.environ.get("SVWFS_HANG_S", "300"))
_TICK_S: Final = 0.01


def wait_until(holds: Callable[[], object]) -> None:
    """Wait until the condition holds; fail after `HANG_S`."""
    deadline_s = time.monotonic() + HANG_S
    while not holds():
        assert time.monotonic() < deadline_s, f"it did not come to that in {HANG_S:g} s"
        time.sleep(0.005)


def udp_socket(address: tuple[str, int]) -> socket.socket:
    """Bind a socket to a fixed address, once no other run of the tests on this computer has it."""
    made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)

    def is_bound() -> bool:
        try:
            made.bind(address)
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise
            return False
        return True

    try:
        wait_until(is_bound)
    except BaseException:
        made.close()
        raise
    return made


@contextmanager
def own_time() -> Iterator[Callable[[], float]]:
    """Count the seconds during which this program was running, to test that something is quick by itself.

    A thread ticks; between two ticks at most two ticks count.
    """
    elapsed_s, is_over = 0.0, threading.Event()

    def tick() -> None:
        nonlocal elapsed_s
        before_s = time.monotonic()
        while not is_over.wait(_TICK_S):
            now_s = time.monotonic()
            elapsed_s += min(now_s - before_s, 2 * _TICK_S)
            before_s = now_s

    ticking = threading.Thread(target=tick, name="own time")
    ticking.start()
    try:
        yield lambda: elapsed_s
    finally:
        is_over.set()
        ticking.join()
