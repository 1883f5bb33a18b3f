"""What the window has asked the acquisition's worker for and has not heard of yet."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import CancelledError, Future
from typing import Any, TypeVar

from app.gui.message_strip import MessageStrip
from app.measurement.routines.frames import Cancelled

T = TypeVar("T")


class Answers:
    """Waits for commands to be executed, and tells which of them were refused, and why."""

    def __init__(self, messages: MessageStrip) -> None:
        self._messages = messages
        self._pending: list[tuple[Future[Any], Callable[[Any], object] | None]] = []

    def restart(self, futures: Iterable[Future[Any]]) -> None:
        """Wait for these only."""
        self._pending = [(future, None) for future in futures]

    def expect(self, future: Future[T], then: Callable[[T], object] | None = None) -> None:
        """Wait for one more; `then` is told its result. What was told of the one before has had its time."""
        self._messages.forget_notice()
        self._pending.append((future, then))

    @property
    def are_all_there(self) -> bool:
        """Whether nothing is waited for."""
        return not self._pending

    def look(self) -> bool:
        """Tell what has been answered; return whether anything has."""
        done = [(future, then) for future, then in self._pending if future.done()]
        self._pending = [(future, then) for future, then in self._pending if not future.done()]
        for future, then in done:
            try:
                result = future.result()
            except (Cancelled, CancelledError):
                self._messages.warn("cancelled")
            except Exception as error:  # noqa: BLE001 - whatever it is, it is told
                self._messages.warn(str(error))
            else:
                if then is not None:
                    then(result)
        return bool(done)
