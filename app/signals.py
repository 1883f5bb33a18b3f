"""The signals by which a person or the system ends the program: each turns the light off and keeps what there is."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

# Ctrl-C; kill, and a shutdown; the terminal's end, or the connection's to it; on Windows that, and Ctrl-Break
_NAMES = ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK")
ENDING = tuple(signal.Signals[name] for name in _NAMES if name in signal.Signals.__members__)


@contextmanager
def ended_by(end: Callable[[int, FrameType | None], object]) -> Iterator[None]:
    """Have `end` called by each of them for as long as this lasts; by no hangup that `nohup` told to ignore."""
    before = {
        number: signal.signal(number, end)
        for number in ENDING
        if number is signal.SIGINT or signal.getsignal(number) is not signal.SIG_IGN
    }
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
