"""What Windows lacks, for tests with the mark `posix`, which are left out there, and what it does otherwise."""

import os
import signal
import threading

__all__ = ["HIDDEN", "KILLED", "SIGHUP", "SIGKILL", "SIGQUIT", "SIGSTOP", "press_ctrl_c", "resource", "tty"]

try:
    import resource
    import tty
except ImportError:
    resource = tty = None  # type: ignore[assignment] # no test that uses them runs

HIDDEN = {os: "fork forkpty killpg mkfifo openpty", signal: "SIGCONT SIGHUP SIGQUIT SIGSTOP pthread_kill"}
SIGHUP, SIGKILL, SIGQUIT, SIGSTOP = (  # on Windows SIGTERM kills
    getattr(signal, name, signal.SIGTERM) for name in ("SIGHUP", "SIGKILL", "SIGQUIT", "SIGSTOP")
)
KILLED = -SIGKILL if os.name == "posix" else 1  # exit status of a process
_kill_thread = getattr(signal, "pthread_kill", None)


def press_ctrl_c() -> None:
    """Interrupt the main thread, from any thread; on Windows `os.kill` would end this process without a handler."""
    if _kill_thread is None:
        signal.raise_signal(signal.SIGINT)
    else:
        _kill_thread(threading.main_thread().ident or 0, signal.SIGINT)
