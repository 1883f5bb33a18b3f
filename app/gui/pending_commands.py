"""Futures of the commands that the window has sent and that are not finished yet."""

from collections.abc import Callable, Iterable
from concurrent.futures import CancelledError, Future
from typing import Any, TypeVar

from app.gui.message_strip import MessageStrip
from app.measurement.routines.frames import Cancelled

T = TypeVar("T")


class PendingCommands:
    """Passes the result of each command to its callback and shows its error as a warning."""

    def __init__(self, messages: MessageStrip) -> None:
        self._messages = messages
        self._pending: list[tuple[Future[Any], Callable[[Any], object] | None]] = []

    def restart(self, futures: Iterable[Future[Any]]) -> None:
        """Forget all pending commands but these."""
        self._pending = [(future, None) for future in futures]

    def add(self, future: Future[T], then: Callable[[T], object] | None = None) -> None:
        """Add a command; `then` receives its result. The notice of an earlier one disappears."""
        self._messages.clear_notice()
        self._pending.append((future, then))

    @property
    def is_empty(self) -> bool:
        """True if all commands are finished."""
        return not self._pending

    def poll(self) -> bool:
        """Report finished commands; return whether there were any."""
        done = [(future, then) for future, then in self._pending if future.done()]
        self._pending = [(future, then) for future, then in self._pending if not future.done()]
        for future, then in done:
            try:
                result = future.result()
            except (Cancelled, CancelledError):
                self._messages.warn("cancelled")
            except Exception as error:  # noqa: BLE001 - every error is shown
                self._messages.warn(str(error))
            else:
                if then is not None:
                    then(result)
        return bool(done)
