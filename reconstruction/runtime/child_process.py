"""Child processes of this Python: their start, pipes, condition and end, the same on every system."""

import ctypes
import os
import signal
import subprocess
import sys
from collections.abc import Mapping
from contextlib import suppress
from io import BufferedReader, BufferedWriter
from pathlib import Path
from threading import Thread
from typing import IO, Literal, TypeAlias

import psutil

Child: TypeAlias = subprocess.Popen[bytes]
Condition: TypeAlias = Literal["alive", "frozen", "gone"]

_CRASHES = 0x80000000  # from here on, exit codes of Windows are those of its exceptions


def start_child(
    code: str,
    *arguments: str,
    environment: Mapping[str, str] | None = None,
    output: IO[bytes] | None = None,
    is_background: bool = False,
) -> Child:
    """Start this Python with a line of code; its pipes are binary, and end it, unless it prints into a file.

    Neither Ctrl-C nor a closed terminal reaches it. In the background it yields to this process; then it stays in the
    session, as niceness counts only there. Nothing from the working directory is imported.
    """
    variables, flags = {**os.environ, **(environment or {})}, 0
    if sys.platform == "win32":
        # A closed console ends all that are attached to it: the child gets one of its own, without a window.
        flags = subprocess.CREATE_NO_WINDOW | subprocess.CREATE_NEW_PROCESS_GROUP
        flags |= subprocess.BELOW_NORMAL_PRIORITY_CLASS if is_background else 0
        variables["__PYVENV_LAUNCHER__"] = sys.executable  # as `multiprocessing` does
        code = code if output is None else f"from {__name__} import heed_requests; heed_requests(); {code}"
    return subprocess.Popen(  # noqa: S603 - this interpreter
        [_interpreter(), "-P", "-c", code, *arguments],
        stdin=subprocess.PIPE if output is None else subprocess.DEVNULL,
        stdout=subprocess.PIPE if output is None else output,
        stderr=output,
        env=variables,
        creationflags=flags,
        start_new_session=not is_background,
        process_group=0 if is_background else None,
    )


def take_pipes() -> tuple[BufferedReader, BufferedWriter]:
    """Return the pipes from and to the parent; libraries find nothing to read, and print to the error stream.

    For a child, before a thread reads and NumPy is imported: NumPy asks about the standard input, and on Windows a
    question about a pipe waits for the thread that reads it.
    """
    pipes = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    with Path(os.devnull).open("rb") as nothing:
        os.dup2(nothing.fileno(), 0)
    os.dup2(2, 1)
    return pipes


class Parent:
    """The process that has started this one."""

    def __init__(self) -> None:
        self._id, self._process = os.getppid(), None
        with suppress(psutil.Error):  # it has just ended
            self._process = psutil.Process(self._id)

    @property
    def has_ended(self) -> bool:
        """True if it is gone, though something else may hold its pipe open."""
        if sys.platform == "win32":  # there a process keeps the number of its parent
            return self._process is None or not self._process.is_running()
        return os.getppid() != self._id

    @property
    def processor_s(self) -> float:
        """Processor time that it has taken so far."""
        with suppress(psutil.Error):
            return 0.0 if self._process is None else sum(self._process.cpu_times()[:2])
        return 0.0


def condition_of(child: Child) -> Condition:
    """Look whether a child is alive, was stopped, or has ended."""
    if child.poll() is not None:
        return "gone"
    with suppress(psutil.Error):
        stopped = psutil.STATUS_STOPPED, psutil.STATUS_TRACING_STOP
        return "frozen" if psutil.Process(child.pid).status() in stopped else "alive"
    return "gone"


def ask_to_end(child: Child) -> None:
    """Ask a child that prints into a file to end in order, as by SIGTERM; the caller waits for the end."""
    if sys.platform == "win32":  # whose `terminate` kills
        windows = ctypes.WinDLL("kernel32")
        windows.SetEvent(_request(child.pid))  # left open: the child may look only later
    else:
        child.terminate()


def heed_requests() -> None:
    """Let `ask_to_end` reach this process on Windows: a thread raises SIGTERM for it."""
    if sys.platform == "win32":
        windows, request = ctypes.WinDLL("kernel32"), _request(os.getpid())

        def wait() -> None:
            windows.WaitForSingleObject(request, -1)
            signal.raise_signal(signal.SIGTERM)

        Thread(target=wait, name="request to end", daemon=True).start()


def _request(process: int) -> int:
    """Make or open the event of Windows that asks a process to end."""
    if sys.platform == "win32":
        return int(ctypes.WinDLL("kernel32").CreateEventW(None, True, False, f"svwfs-end-{process}"))
    return 0


def crash_of(child: Child) -> str:
    """Say what ended a child that did not end itself; empty if it did, or is alive."""
    code = child.returncode or 0
    if code >= _CRASHES:
        return f"crashed with the Windows error {code:#x}"
    return f"was ended by {signal.Signals(-code).name}" if code < 0 else ""


def _interpreter() -> str:
    """Path of the Python to start; on Windows that of a virtual environment only starts another process."""
    if sys.platform == "win32":
        found = Path(getattr(sys, "_base_executable", sys.executable))
        console = found.with_name(found.name.lower().replace("pythonw", "python"))  # its standard streams are complete
        return str(console if console.exists() else found)
    return sys.executable
