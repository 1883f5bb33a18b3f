"""What is set for the whole process, for as long as anybody in it wants that."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import RLock


class ProcessSetting:
    """One such setting: the first who wants it brings it into force, and the last to leave takes it away.

    Several threads may want it at once, and leave in any order.
    """

    def __init__(self, begin: Callable[[], Callable[[], object]]) -> None:
        """`begin` brings it into force and returns what brings back how it was before."""
        self._begin = begin
        self._changing = RLock()  # also when, in the middle of it, a forgotten generator leaves in the same thread
        self._wanted_by = 0
        self._restore: Callable[[], object] | None = None

    @contextmanager
    def wanted(self) -> Iterator[None]:
        """Have it in force while a `with` lasts."""
        self._enter()
        try:
            yield
        finally:
            self._leave()

    def _enter(self) -> None:
        with self._changing:
            self._wanted_by += 1
            if self._restore is None:
                self._restore = self._begin()

    def _leave(self) -> None:
        with self._changing:
            self._wanted_by -= 1
            if not self._wanted_by and self._restore is not None:
                self._restore()
                self._restore = None
