"""The connection to the instrument of this window: closing it ends the instrument, unless its user lets it continue."""

import subprocess
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from app.acquisition.address import Address
from app.acquisition.remote.connection import Connection
from app.bench.config import Bench
from app.errors import RunError
from reconstruction.runtime.child_process import Child, ask_to_end, crash_of

_LOOK_S = 0.05  # between two looks for an instrument that starts
_STARTS_S = 60.0  # on a busy computer
_ENDED_S = 0.5  # from the end of its connections to that of a process that crashes


class OwnConnection(Connection):
    """Ends the instrument when it is closed, unless that `goes_on` or another client controls it."""

    _retakes_control = True

    def __init__(self, bench: Bench, name: str, process: Child, *, log: Path, forget_bench: Callable[[], None]) -> None:
        """Begin to connect to a process just started, which prints into `log`; `forget_bench` removes its file."""
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
            if self._closing.wait(_LOOK_S):
                ask_to_end(self.process)
                return
            if self.process.poll() is not None:
                printed = self._log.read_text(errors="replace").strip().splitlines()
                last = printed[-1].removeprefix("svwfs: ") if printed else "it said nothing"
                raise RunError(f"the instrument's process has ended: {last}")
            if time.monotonic() > until_s:
                self.process.kill()
                raise RunError(f"the instrument's process could not be reached within {_STARTS_S:g} s, and was ended")
        self._forget_bench()  # it was read; a window that is killed leaves none
        super()._reach()

    def _is_announced(self) -> bool:
        """True if the process has the name, and its address is known; another one may have taken it."""
        with suppress(RunError):  # not yet
            self.address = Address.of(self.address.name)
        return bool(self.address.key) and self.address.process == self.process.pid

    def _how_it_ended(self) -> str:
        with suppress(subprocess.TimeoutExpired):
            self.process.wait(_ENDED_S)
        return crash_of(self.process) or super()._how_it_ended()

    def begin_close(self) -> None:
        """End the instrument, light first, or leave it."""
        if not self._is_ending and self.process.poll() is None:
            self.goes_on |= self.is_of_another
            self._is_ending = not self.goes_on
            if self._is_ending and super().is_alive:
                self.end()
            elif self._is_ending:  # only this end has failed
                ask_to_end(self.process)
        super().begin_close()

    def close(self, timeout_s: float | None = None) -> None:
        """End or leave the instrument, and wait for that."""
        super().close(timeout_s)
        if self._is_ending:
            with suppress(subprocess.TimeoutExpired):
                self.process.wait(timeout_s)
