"""Errors that end a command, one sentence each with an exit status for scripts; signals."""

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

SHOWN = "shown in the window"  # note on an error that the user has seen there
NOTHING_TO_WRITE = "there is nothing to write: no frame has a wavefront"
SETTINGS_CHANGED = "the settings changed between these frames: select frames with equal settings (--frames)"


class InputError(Exception):
    """Unusable input: a file, a setting, a frame. Exit status 2."""


class Interrupted(BaseException):
    """The user or the system ended the command early; the text says what was saved. Exit status 130.

    Not an `Exception`, so that no handler mistakes it for a fault.
    """


class RunError(Exception):
    """Failure while running: a device, the disk. Exit status 1."""


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
