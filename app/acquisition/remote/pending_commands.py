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
from app.acquisition.remote.messages import MOST_BYTES, Answer, Command
from app.acquisition.serialization import encoded
from app.errors import RunError
from drivers.errors import BadValue

P = ParamSpec("P")
T = TypeVar("T")

ANSWER_S = 5.0  # for a command to be accepted, and for the first state
_ON_ITS_WAY_S = 1.0  # for the news that it was accepted


class PendingCommands:
    """Takes commands from any thread, for the one that sends them."""

    def __init__(self, notify: Callable[[], object]) -> None:
        """`notify` wakes the sender."""
        self._notify = notify
        self._refusal: Exception | None = None  # of all commands, once closed
        self._numbers, self._lock = itertools.count(1), threading.Lock()
        self._waiting: list[Command] = []
        self._unanswered: dict[int, tuple[Future[Any], float]] = {}  # with the time until which it must be accepted

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
            nbytes = encoded(command).nbytes
        except RunError as refusal:
            future.set_exception(refusal)
            return future
        if nbytes > MOST_BYTES:
            future.set_exception(BadValue(f"{request}: this is too large to be sent to the instrument"))
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
                self._expect(command.number, now_s + ANSWER_S)
        until_s = now_s + ANSWER_S - _ON_ITS_WAY_S
        return [replace(command, until_s=until_s) for command in taken]

    def note_accepted(self, number: int) -> None:
        """Note that a command has arrived, and may take its time."""
        self._expect(number, math.inf)

    def _expect(self, number: int, until_s: float) -> None:
        if number in self._unanswered:
            self._unanswered[number] = self._unanswered[number][0], until_s

    def note_answer(self, answer: Answer) -> None:
        """Resolve the future of a command."""
        future, _ = self._unanswered.pop(answer.number, (None, 0.0))
        if future is not None and answer.error is None:
            future.set_result(answer.result)
        elif future is not None:
            future.set_exception(answer.error)

    def give_up_lost(self) -> None:
        """Fail the commands that have not been accepted in time."""
        for number, (future, until_s) in list(self._unanswered.items()):
            if time.monotonic() > until_s:
                del self._unanswered[number]
                future.set_exception(RunError("the instrument does not answer"))

    def close(self, why: Exception) -> None:
        """Fail all commands without an answer, and take none any more."""
        with self._lock:
            left, self._unanswered, self._refusal = list(self._unanswered.values()), {}, why
        for future, _ in left:
            future.set_exception(why)
