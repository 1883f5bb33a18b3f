"""The instrument of a window: a process that the window starts, and that ends with it unless its user lets it go on."""

import subprocess
import tempfile
import time
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Self

from app.acquisition.place import NAME, is_taken
from app.acquisition.remote.connection import Connection
from app.bench.config import Bench, save_bench
from app.errors import RunError
from app.run_facts import command_line

_LOOK_S = 0.05  # between two looks for an instrument that starts
_ENDS_S = 45.0  # a frame of the slowest method takes up to half of it


class OwnConnection(Connection):
    """A connection that ends the instrument when it is closed, unless it `goes_on` or another client controls it."""

    def __init__(self, name: str, process: subprocess.Popen[bytes]) -> None:
        """Connect as the window that has started this process; see `Connection`."""
        self.process = process
        self._ends = False
        super().__init__("window", name)
        self.goes_on = False

    @property
    def is_alive(self) -> bool:
        """True while the instrument runs and this connection is open, and until it has ended if it ends."""
        return super().is_alive or (self._ends and self.process.poll() is None)

    def begin_close(self) -> None:
        """End the instrument, light first, or leave it."""
        if super().is_alive and not self.goes_on and not self.is_of_another:
            self._ends = True
            self.end()
        super().begin_close()

    def close(self, timeout_s: float | None = None) -> None:
        """End or leave the instrument, and wait for that."""
        super().close(timeout_s)
        if self._ends:
            with suppress(subprocess.TimeoutExpired):
                self.process.wait(timeout_s)


class OwnInstrument:
    """Runs one bench after the other in a process of its own, `svwfs serve`, which it leaves to a connection."""

    def __init__(self, name: str = NAME) -> None:
        """`RunError` if another instrument has the name."""
        if is_taken(name):
            raise RunError(
                f"an instrument runs as {name} already: svwfs live --attach shows it; another one needs a --name"
            )
        self._name = name
        self._bench: Bench | None = None  # of the process
        self._process: subprocess.Popen[bytes] | None = None
        self._connection: OwnConnection | None = None
        self._folder = tempfile.TemporaryDirectory(prefix="svwfs-", ignore_cleanup_errors=True)
        self._said = Path(self._folder.name, "said.txt")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        """End a process that nobody has been connected to."""
        if self._connection is None:
            self._end()
        self._folder.cleanup()

    def start(self, bench: Bench) -> subprocess.Popen[bytes]:
        """Start the process for a bench, whose libraries are trusted, unless it runs; return at once."""
        if self._process is not None and self._process.poll() is None and self._bench == bench:
            return self._process
        self._end()
        file, self._bench = Path(self._folder.name, "bench.toml"), bench
        save_bench(file, bench)
        program, arguments = command_line("serve", "--bench", file, "--name", self._name, "--trust-library", "--idle")
        with self._said.open("wb") as said:
            # In a session of its own: Ctrl-C in the terminal ends the window, which decides what becomes of it.
            self._process = subprocess.Popen(  # noqa: S603 - this program
                [program, *arguments], stdin=subprocess.DEVNULL, stdout=said, stderr=said, start_new_session=True
            )
        return self._process

    def connect(self, bench: Bench) -> OwnConnection:
        """Connect to the process of a bench, started if need be; `RunError` with its last words if it ends before.

        The connection before is closed, or its instrument has ended.
        """
        if self._connection is not None:
            self._connection = None
            self._wait()
        process = self.start(bench)
        while not is_taken(self._name):
            if process.poll() is not None:
                said = self._said.read_text(errors="replace").strip().splitlines()
                raise RunError(f"the instrument's process has ended: {said[-1] if said else 'it said nothing'}")
            time.sleep(_LOOK_S)
        self._connection = OwnConnection(self._name, process)
        return self._connection

    def _end(self) -> None:
        if self._process is not None and self._process.poll() is None:
            self._process.terminate()
            self._wait()

    def _wait(self) -> None:
        """Wait until the devices are closed; `RunError` if they do not close."""
        if self._process is None:
            return
        try:
            self._process.wait(_ENDS_S)
        except subprocess.TimeoutExpired as error:
            raise RunError(
                f"the instrument's process {self._process.pid} does not end: its devices are still open"
            ) from error
