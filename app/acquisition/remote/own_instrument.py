"""The instrument of a window: a process that ends with it unless its user lets it go on."""

import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Self

from app.acquisition.address import NAME, Address, file_of, is_taken
from app.acquisition.instrument import CLOSING_S
from app.acquisition.remote.connection import Connection
from app.bench.config import Bench, save_bench
from app.errors import RunError
from app.run_facts import command_line

_LOOK_S = 0.05  # between two looks for an instrument that starts
_LEAVES_S = 5.0  # the window has waited for its end already
_STARTS_S = 60.0  # on a busy computer
_ENDED_S = 0.5  # from the end of its connections to that of a process that crashes


class OwnConnection(Connection):
    """Ends the instrument when it is closed, unless that `goes_on` or another client controls it."""

    def __init__(
        self, bench: Bench, name: str, process: subprocess.Popen[bytes], *, log: Path, forget_bench: Callable[[], None]
    ) -> None:
        """Begin to connect to a process that has just been started, and prints into the file `log`.

        `forget_bench` removes the file of the bench. If it cannot be reached, that is the connection's `error`.
        """
        self.bench, self.process, self._log, self._forget_bench = bench, process, log, forget_bench
        self._is_ending = self.goes_on = False
        super().__init__("window", Address(name, process.pid, endpoint="", key=""))

    @property
    def is_alive(self) -> bool:
        """True while the instrument runs and this connection is open, and until it has ended if it ends."""
        return super().is_alive or (self._is_ending and self.process.poll() is None)

    @property
    def loss(self) -> str:
        """As of any connection; the end that this one has asked for is none."""
        return "" if self._is_ending else super().loss

    def _reach(self) -> None:
        until_s = time.monotonic() + _STARTS_S
        while not self._is_announced():
            if self._closing.is_set():
                self.process.terminate()
                return
            if self.process.poll() is not None:
                printed = self._log.read_text(errors="replace").strip().splitlines()
                last = printed[-1].removeprefix("svwfs: ") if printed else "it said nothing"
                raise RunError(f"the instrument's process has ended: {last}")
            if time.monotonic() > until_s:
                self.process.kill()
                raise RunError(f"the instrument's process could not be reached within {_STARTS_S:g} s, and was ended")
            time.sleep(_LOOK_S)
        self._forget_bench()  # it was read; a window that is killed leaves none
        self.address = Address.of(self.address.name)
        super()._reach()

    def _is_announced(self) -> bool:
        """True if the process has the name; another one may have taken it."""
        if not is_taken(self.address.name):
            return False
        # On Windows, the process of a virtual environment starts another one.
        return sys.platform == "win32" or Address.of(self.address.name).process == self.process.pid

    def _how_it_ended(self) -> str:
        with suppress(subprocess.TimeoutExpired):
            self.process.wait(_ENDED_S)
        code = self.process.returncode
        return super()._how_it_ended() if code is None or code >= 0 else f"was ended by {signal.Signals(-code).name}"

    def begin_close(self) -> None:
        """End the instrument, light first, or leave it."""
        if not self._is_ending and self.process.poll() is None:
            self.goes_on |= self.is_of_another
            self._is_ending = not self.goes_on
            if self._is_ending and super().is_alive:
                self.end()
            elif self._is_ending:  # only this end has failed
                self.process.terminate()
        super().begin_close()

    def close(self, timeout_s: float | None = None) -> None:
        """End or leave the instrument, and wait for that."""
        super().close(timeout_s)
        if self._is_ending:
            with suppress(subprocess.TimeoutExpired):
                self.process.wait(timeout_s)


class OwnInstrument:
    """Runs one bench after the other in a process of its own, `svwfs serve`."""

    def __init__(self, name: str = NAME) -> None:
        self._name = name
        self._bench: Bench | None = None  # of the process
        self._process: subprocess.Popen[bytes] | None = None
        self._connection: OwnConnection | None = None
        self._folder = tempfile.TemporaryDirectory(prefix="svwfs-", ignore_cleanup_errors=True)

    @property
    def _log(self) -> Path:
        """File of what the process prints, also when it goes on without this window."""
        return file_of(self._name, "log")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        """End the process, unless it is to go on: then its log stays."""
        if self._connection is not None:
            self._connection.close(_LEAVES_S)
        else:
            self._end()
        self._tell_crash()
        if self._process is not None and not is_taken(self._name):
            with suppress(OSError):  # Windows keeps an open file
                self._log.unlink()
        self._folder.cleanup()

    def start(self, bench: Bench) -> subprocess.Popen[bytes]:
        """Start the process for a bench, whose libraries are confirmed, unless it runs; return at once.

        `RunError` if another instrument has the name.
        """
        if self._process is not None and self._process.poll() is None and self._bench == bench:
            return self._process
        self._end()
        self._tell_crash()
        if is_taken(self._name):
            named = "" if self._name == NAME else f" --name {self._name}"
            raise RunError(
                f"an instrument runs as {self._name} already: svwfs live --attach{named} shows it; another one needs a"
                " --name"
            )
        file, self._bench = Path(self._folder.name, "bench.toml"), bench
        file.parent.mkdir(mode=0o700, exist_ok=True)
        save_bench(file, bench)
        program, arguments = command_line("serve", "--bench", file, "--name", self._name, "--idle")
        try:
            with self._log.open("ab") as log:  # another window may do the same at this moment
                log.truncate(0)
                self._process = subprocess.Popen(  # noqa: S603 - this program
                    [program, *arguments],
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=log,
                    # Ctrl-C in the terminal ends the window, which decides what becomes of the instrument.
                    start_new_session=True,
                    creationflags=getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0),  # exists on Windows only
                )
        except OSError as error:
            raise RunError(f"the instrument's process cannot be started: {error}") from error
        return self._process

    def connect(self, bench: Bench) -> OwnConnection:
        """Begin to connect to the process of a bench, started if need be, after the end of the one before.

        `RunError` if the one before does not end, or goes on, or as `start`.
        """
        if self._connection is not None:
            self._connection.close(CLOSING_S)
            if self._connection.process.poll() is None:
                why = "goes on" if self._connection.goes_on else "does not end"
                raise RunError(f"the instrument's process {self._connection.process.pid} {why}: its devices are in use")
            self._connection = None
        self._connection = OwnConnection(
            bench, self._name, self.start(bench), log=self._log, forget_bench=self._folder.cleanup
        )
        return self._connection

    def _tell_crash(self) -> None:
        """Print what a process said that a signal has ended: where it crashed."""
        if self._process is not None and (self._process.poll() or 0) < 0:
            sys.stderr.write(self._log.read_text(errors="replace"))

    def _end(self) -> None:
        """End a process that nobody has been connected to."""
        if self._process is not None and self._process.poll() is None:
            self._process.terminate()
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(CLOSING_S)
