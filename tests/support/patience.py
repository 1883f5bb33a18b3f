"""How long a test waits: until it is so. The computer may be slow, shared, and stand still now and then."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Final

HANG_S: Final = 300.0  # only what hangs takes longer, also where Numba still has to compile everything on one slow core
_TICK_S: Final = 0.01


def wait_until(holds: Callable[[], object]) -> None:
    """Wait until it holds; fail when it never does."""
    deadline_s = time.monotonic() + HANG_S
    while not holds():
        assert time.monotonic() < deadline_s, f"it did not come to that in {HANG_S:g} s"
        time.sleep(0.005)


@contextmanager
def own_time() -> Iterator[Callable[[], float]]:
    """Count the seconds from here on, without those in which the computer let this program stand still.

    For what must be quick by itself, such as telling that a plug was pulled. A thread ticks; between two ticks, no more
    than two count.
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
