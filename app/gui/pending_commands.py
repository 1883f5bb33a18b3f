"""Futures of the commands that the window has sent and that are not finished yet."""

from collections.abc import Callable, Iterable
from concurrent.futures import CancelledError, Future
from typing import Any, TypeVar

from app.gui.message_strip import MessageStrip
from app.measurement.routines import Cancelled

T = TypeVar("T")


class PendingCommands:
    """Passes the result of each command to its callback and shows its error as a warning."""

    def __init__(self, messages: MessageStrip) -> None:
        self._messages = messages
        self._pending: list[
            tuple[Future[Any], Callable[[Any], object] | None, Callable[[Exception], object] | None]
        ] = []

    def restart(self, futures: Iterable[Future[Any]]) -> None:
        """Forget all pending commands but these."""
        self._pending = [(future, None, None) for future in futures]

    def add(
        self,
        future: Future[T],
        then: Callable[[T], object] | None = None,
        otherwise: Callable[[Exception], object] | None = None,
    ) -> None:
        """Add a command; `then` receives its result, `otherwise` its error. An earlier notice disappears."""
        self._messages.clear_notice()
        self._pending.append((future, then, otherwise))

    @property
    def is_empty(self) -> bool:
        """True if all commands are finished."""
        return not self._pending

    @property
    def is_done(self) -> bool:
        """True if all commands are finished, also those that are not reported yet."""
        return all(future.done() for future, _, _ in self._pending)

    def poll(self) -> bool:
        """Report finished commands; return whether there were any."""
        done = [pending for pending in self._pending if pending[0].done()]
        self._pending = [pending for pending in self._pending if pending not in done]
        for future, then, otherwise in done:
            try:
                result = future.result()
            except (Cancelled, CancelledError) as error:
                self._messages.warn("cancelled")
                if otherwise is not None:
                    otherwise(error)
            except Exception as error:  # noqa: BLE001 - every error is shown
                self._messages.warn(str(error))
                if otherwise is not None:
                    otherwise(error)
            else:
                if then is not None:
                    then(result)
        return bool(done)
