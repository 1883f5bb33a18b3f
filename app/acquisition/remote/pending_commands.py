"""Commands of a client that wait to be sent, or for an answer."""

import itertools
import math
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from typing import Any, Concatenate, ParamSpec, TypeVar

from app.acquisition.instrument import Instrument
from app.acquisition.remote.messages import Answer, Command
from app.acquisition.serialization import MOST_BYTES, Message
from app.errors import RunError
from drivers.errors import BadValue

P = ParamSpec("P")
T = TypeVar("T")

ANSWER_S = 5.0  # for a sign of life after a command, and for the first state
_PULSE_S = 1.0  # in which a sign of life comes from an instrument that lives


class PendingCommands:
    """Takes commands from any thread, for the one that sends them."""

    def __init__(self, notify: Callable[[], object]) -> None:
        """`notify` wakes the sender."""
        self._notify = notify
        self._refusal: Exception | None = None  # of all commands, once closed
        self._numbers, self._lock = itertools.count(1), threading.Lock()
        self._waiting: list[Command] = []
        self._unanswered: dict[int, tuple[Future[Any], float]] = {}  # with the time when it was sent

    def submit(
        self, command: Callable[Concatenate[Instrument, P], T], /, *arguments: P.args, **named: P.kwargs
    ) -> Future[T]:
        """Take a command that is a method of the instrument."""
        return self.add(command.__name__, *arguments, **named)

    def add(self, request: str, /, *arguments: Any, **named: Any) -> Future[Any]:
        """Take a command and return its future; relative paths are those of this process."""
        arguments = tuple(each.absolute() if isinstance(each, Path) else each for each in arguments)
        future: Future[Any] = Future()
        future.set_running_or_notify_cancel()  # what is sent cannot be called back
        command = Command(next(self._numbers), request, arguments, named)
        try:
            if Message(command).nbytes > MOST_BYTES:
                raise BadValue(f"{request}: this is too large to be sent to the instrument")  # noqa: TRY301 - as others
        except (BadValue, RunError) as refusal:
            future.set_exception(refusal)
            return future
        with self._lock:
            if self._refusal is None:
                self._unanswered[command.number] = future, math.inf
                self._waiting.append(command)
                self._notify()
                return future
        future.set_exception(self._refusal)
        return future

    def take(self) -> list[Command]:
        """Return the commands to send now; each must begin before it is given up here."""
        now_s = time.monotonic()
        with self._lock:
            taken, self._waiting = self._waiting, []
            for command in taken:
                self._unanswered[command.number] = self._unanswered[command.number][0], now_s
        return [replace(command, until_s=now_s + ANSWER_S - _PULSE_S) for command in taken]

    def note_answer(self, answer: Answer) -> None:
        """Resolve the future of a command."""
        future, _ = self._unanswered.pop(answer.number, (None, 0.0))
        if future is not None and answer.error is None:
            future.set_result(answer.result)
        elif future is not None:
            future.set_exception(answer.error)

    def give_up_lost(self, heard_s: float) -> None:
        """Fail the commands after which the instrument, heard last at a time, has given no sign of life."""
        for number, (future, sent_s) in list(self._unanswered.items()):
            if time.monotonic() > sent_s + ANSWER_S and heard_s < sent_s + _PULSE_S:
                del self._unanswered[number]
                future.set_exception(RunError("the instrument does not answer"))

    def close(self, why: Exception) -> None:
        """Fail all commands without an answer, and take none any more."""
        with self._lock:
            left, self._unanswered, self._refusal = list(self._unanswered.values()), {}, why
        for future, _ in left:
            future.set_exception(why)
