"""The instrument of a window: a process that ends with it unless its user lets it continue.

It is started before what connects to it is loaded, which takes a second.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Self

from app.acquisition.address import CLOSING_S, NAME, NameTaken, file_of, is_taken
from app.bench.config import Bench, save_bench
from app.errors import RunError
from app.run_facts import MAIN
from reconstruction.runtime.child_process import Child, ask_to_end, crash_of, start_child

if TYPE_CHECKING:
    from app.acquisition.remote.own_connection import OwnConnection

_LEAVES_S = 5.0  # the window has waited for its end already


class OwnInstrument:
    """Runs one bench after the other in a process of its own, `svwfs serve`."""

    def __init__(self, name: str = NAME) -> None:
        self.name = name
        self._bench: Bench | None = None  # of the process
        self._process: Child | None = None
        self._connection: OwnConnection | None = None
        self._folder = tempfile.TemporaryDirectory(prefix="svwfs-", ignore_cleanup_errors=True)

    @property
    def _log(self) -> Path:
        """File of what the process prints, also when it continues without this window."""
        return file_of(self.name, "log")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        """End the process, unless it is to continue: then its log stays."""
        if self._connection is not None:
            self._connection.close(_LEAVES_S)
        else:
            self._end()
        self._tell_crash()
        if self._process is not None and not is_taken(self.name):
            with suppress(OSError):  # Windows keeps an open file
                self._log.unlink()
        self._folder.cleanup()

    def start(self, bench: Bench) -> Child:
        """Start the process for a bench with confirmed libraries, unless it runs; `NameTaken` if the name is in use."""
        if self._process is not None and self._process.poll() is None and self._bench == bench:
            return self._process
        self._end()
        self._tell_crash()
        if is_taken(self.name):
            named = "" if self.name == NAME else f" --name {self.name}"
            raise NameTaken(
                f"an instrument named {self.name} is running already: show it (svwfs live --attach{named}), or start"
                " another one with --name"
            )
        file, self._bench = Path(self._folder.name, "bench.toml"), bench
        file.parent.mkdir(mode=0o700, exist_ok=True)
        save_bench(file, bench)
        arguments = ("serve", "--bench", str(file), "--name", self.name, "--idle")
        try:
            with self._log.open("ab") as log:  # another window may do the same at this moment
                log.truncate(0)
                log.seek(0)  # on Windows the process writes where this file stands
                self._process = start_child(MAIN, *arguments, output=log)  # this window decides when it ends
        except OSError as error:
            raise RunError(f"the instrument's process cannot be started: {error}") from error
        return self._process

    def connect(self, bench: Bench) -> OwnConnection:
        """Begin to connect to the process of a bench, after the end of the one before; `RunError` if that stays."""
        from app.acquisition.remote.own_connection import OwnConnection  # noqa: PLC0415 - takes a second to load

        if self._connection is not None:
            self._connection.close(CLOSING_S)
            if self._connection.process.poll() is None:
                why = "keeps running" if self._connection.goes_on else "does not end"
                raise RunError(f"the instrument's process {self._connection.process.pid} {why}: its devices are in use")
            self._connection = None
        self._connection = OwnConnection(
            bench, self.name, self.start(bench), log=self._log, forget_bench=self._folder.cleanup
        )
        return self._connection

    def _tell_crash(self) -> None:
        """Print what a process said that a signal has ended: where it crashed."""
        if self._process is not None and self._process.poll() is not None and crash_of(self._process):
            sys.stderr.write(self._log.read_text(errors="replace"))

    def _end(self) -> None:
        """End a process that nobody has been connected to."""
        if self._process is not None and self._process.poll() is None:
            ask_to_end(self._process)
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(CLOSING_S)
