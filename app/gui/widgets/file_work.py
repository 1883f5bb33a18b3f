"""File work on threads: a disk of the network may answer late, and the window continues meanwhile."""

import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, wait
from typing import Any, NamedTuple, TypeVar

from PyQt6.QtCore import QObject

from app.errors import InputError, RunError
from app.gui.widgets.timers import REFRESH_MS, timer
from app.progress import run_in_thread

T = TypeVar("T")
_ANSWER_S = 0.3  # a question about files that takes longer has no answer
_CLOSING_S = 5.0


class _Piece(NamedTuple):
    work: Callable[[], Any]
    then: Callable[[Any], object]  # receives the result
    writes: str  # what a closing window waits for; empty if it only reads


class FileWork(QObject):
    """Does one piece of work after the other on threads, and passes on results in the window's thread."""

    def __init__(self, parent: QObject, warn: Callable[[str], object]) -> None:
        """`warn` receives the sentence of an `InputError` or `RunError`."""
        super().__init__(parent)
        self._warn, self._is_closed = warn, False
        self._pieces: deque[_Piece] = deque()  # the first is under way
        self._result: Future[Any] | None = None  # of the first
        self._timer = timer(self, REFRESH_MS, self._poll)

    @property
    def is_busy(self) -> bool:
        return self._result is not None

    def run(self, work: Callable[[], T], then: Callable[[T], object], *, writes: str = "") -> None:
        """Do some work after what was asked for before; `then` receives its result, `writes` names what it saves."""
        if self._is_closed:  # as by what follows from a piece that was waited for
            return
        self._pieces.append(_Piece(work, then, writes))
        if self._result is None:
            self._begin()

    def forget(self) -> None:
        """Begin nothing more, and pass on no result of what is under way."""
        self._timer.stop()
        self._pieces.clear()
        self._result = None

    def close(self) -> list[str]:
        """Wait five seconds at most until everything is written, and return what was not, and why."""
        end_s, failed = time.monotonic() + _CLOSING_S, list[str]()
        self._warn, self._is_closed = failed.append, True  # the window shows nothing any more
        while self._result is not None and any(piece.writes for piece in self._pieces):
            wait([self._result], max(end_s - time.monotonic(), 0))
            if not self._result.done():
                late = "not saved: the disk has not answered when the window was closed"
                failed += [f"{piece.writes}: {late}" for piece in self._pieces if piece.writes]
                break
            self._poll()
        self.forget()
        return failed

    def _begin(self) -> None:
        self._result, _ = run_in_thread(self._pieces[0].work, "files")
        self._timer.start()

    def _poll(self) -> None:
        if self._result is None or not self._result.done():
            return
        result, self._result, piece = self._result, None, self._pieces.popleft()
        self._timer.stop()
        if self._pieces:
            self._begin()
        try:
            found = result.result()
        except (InputError, RunError) as error:
            self._warn(str(error))
        else:
            piece.then(found)


def answer(question: Callable[[], T], otherwise: T) -> T:
    """Return the answer to a short question about files, or `otherwise` if the disk is late or fails."""
    try:
        return run_in_thread(question, "files")[0].result(_ANSWER_S)
    except (TimeoutError, OSError):
        return otherwise
