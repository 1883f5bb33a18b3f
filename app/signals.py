"""Signals that end the program: handlers that turn the light off and keep the results."""

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

# Ctrl-C; kill and shutdown; a closed terminal or connection; on Windows that and Ctrl-Break
_NAMES = ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK")
ENDING = tuple(signal.Signals[name] for name in _NAMES if name in signal.Signals.__members__)


@contextmanager
def ended_by(end: Callable[[int, FrameType | None], object]) -> Iterator[None]:
    """Call `end` on each of these signals inside a `with`, except those that `nohup` ignores."""
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
