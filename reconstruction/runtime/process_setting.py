"""Reference-counted process-wide setting."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import RLock


class ProcessSetting:
    """A setting in force while at least one `with ... .wanted()` block runs, in any thread."""

    def __init__(self, begin: Callable[[], Callable[[], object]]) -> None:
        """`begin` applies the setting and returns a function that restores the previous state."""
        self._begin = begin
        self._changing = RLock()  # re-entrant: garbage collection may end another block here
        self._wanted_by = 0
        self._restore: Callable[[], object] | None = None

    @contextmanager
    def wanted(self) -> Iterator[None]:
        """Keep the setting in force inside a `with` block."""
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
