"""Guard of the window: an error in a timer or a slot becomes a red message, and the window goes on."""

import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType


class Guard:
    """Wraps functions; each distinct error is shown and printed once until `restart`."""

    def __init__(self, show: Callable[[str], object]) -> None:
        """`show` receives a sentence for the user."""
        self._show = show
        self._known: set[str] = set()

    def restart(self) -> None:
        """Report known errors again: another bench is open."""
        self._known.clear()

    def __call__(self, act: Callable[[], object]) -> Callable[[], None]:
        """Return a slot that calls `act` and reports its errors."""

        def guarded() -> None:
            try:
                act()
            except Exception as error:  # noqa: BLE001 - reported; without the next refresh, the window would be dead
                if self.report(error):
                    sys.excepthook(type(error), error, error.__traceback__)

        return guarded

    def report(self, error: BaseException) -> bool:
        """Show an error, and return whether it is a new one."""
        at = traceback.extract_tb(error.__traceback__)[-1]
        sentence = (
            f"the display failed ({type(error).__name__}: {error}; {Path(at.filename).name}:{at.lineno}), so that what"
            " you see may be old: open the bench again, and report this line of the log (Ctrl+L)"
        )
        if sentence in self._known:
            return False
        self._known.add(sentence)
        self._show(sentence)
        return True

    @contextmanager
    def of_slots(self) -> Iterator[None]:
        """Report errors that nothing catches, as those of slots, after which Qt would abort with the light on."""
        before = sys.excepthook

        def report(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
            before(kind, error, trace)
            if isinstance(error, Exception):
                self.report(error)

        sys.excepthook = report
        try:
            yield
        finally:
            sys.excepthook = before
