"""Guard of the window's timers: an error becomes a red message, and the timer goes on."""

import sys
import traceback
from collections.abc import Callable
from pathlib import Path


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
                self._report(error)

        return guarded

    def _report(self, error: Exception) -> None:
        at = traceback.extract_tb(error.__traceback__)[-1]
        sentence = (
            f"the display failed ({type(error).__name__}: {error}; {Path(at.filename).name}:{at.lineno}), so that what"
            " you see may be old: open the bench again, and report this line of the log (Ctrl+L)"
        )
        if sentence not in self._known:
            self._known.add(sentence)
            self._show(sentence)
            sys.excepthook(type(error), error, error.__traceback__)
