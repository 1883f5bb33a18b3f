"""File work on threads: a disk of the network may answer late, and the window goes on meanwhile."""

import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, wait
from typing import Any, TypeVar

from PyQt6.QtCore import QObject

from app.errors import InputError, RunError
from app.gui.widgets.timers import REFRESH_MS, timer
from app.progress import run_in_thread

T = TypeVar("T")
_ANSWER_S = 0.3  # a question about files that takes longer has no answer
_CLOSING_S = 5.0


class FileWork(QObject):
    """Does one piece of work after the other, each on a thread, and passes on its result in the window's thread."""

    def __init__(self, parent: QObject, warn: Callable[[str], object], *, is_writing: bool = False) -> None:
        """`warn` receives the sentence of an `InputError` or `RunError`; a closing window waits for what is written."""
        super().__init__(parent)
        self._warn, self._is_writing = warn, is_writing
        self._pieces: deque[tuple[Callable[[], Any], Callable[[Any], object]]] = deque()  # the first is under way
        self._result: Future[Any] | None = None  # of the first
        self._timer = timer(self, REFRESH_MS, self._poll)

    def run(self, work: Callable[[], T], then: Callable[[T], object]) -> None:
        """Do some work after what was asked for before; `then` receives its result."""
        self._pieces.append((work, then))
        if self._result is None:
            self._begin()

    def forget(self) -> None:
        """Begin nothing more, and pass on no result of what is under way."""
        self._timer.stop()
        self._pieces.clear()
        self._result = None

    def close(self) -> None:
        """Wait until everything is written, but no longer than five seconds; forget what is read."""
        end_s = time.monotonic() + _CLOSING_S
        while self._is_writing and self._result is not None and (left_s := end_s - time.monotonic()) > 0:
            wait([self._result], left_s)
            self._poll()
        self.forget()

    def _begin(self) -> None:
        self._result, _ = run_in_thread(self._pieces[0][0], "files")
        self._timer.start()

    def _poll(self) -> None:
        if self._result is None or not self._result.done():
            return
        result, self._result, (_, then) = self._result, None, self._pieces.popleft()
        self._timer.stop()
        if self._pieces:
            self._begin()
        try:
            found = result.result()
        except (InputError, RunError) as error:
            self._warn(str(error))
        else:
            then(found)


def answer(question: Callable[[], T], otherwise: T) -> T:
    """Return the answer to a short question about files, or `otherwise` if the disk does not give it in time."""
    try:
        return run_in_thread(question, "files")[0].result(_ANSWER_S)
    except TimeoutError:
        return otherwise
