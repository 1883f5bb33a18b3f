"""What Windows lacks, for tests with the mark `posix`, which are left out there; a kill is SIGTERM there."""

import os
import signal

__all__ = ["HIDDEN", "SIGHUP", "SIGKILL", "SIGQUIT", "SIGSTOP", "resource", "tty"]

try:
    import resource
    import tty
except ImportError:
    resource = tty = None  # type: ignore[assignment] # no test that uses them runs

HIDDEN = {os: "fork forkpty killpg mkfifo openpty", signal: "SIGCONT SIGHUP SIGQUIT SIGSTOP"}
SIGHUP, SIGKILL, SIGQUIT, SIGSTOP = (
    getattr(signal, name, signal.SIGTERM) for name in ("SIGHUP", "SIGKILL", "SIGQUIT", "SIGSTOP")
)
