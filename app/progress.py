"""Long work: progress callbacks, counts in words, independent tasks, and threads of their own."""

import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future
from typing import Protocol, TypeVar

T = TypeVar("T")
R = TypeVar("R")

LINES = "SVWFS_PROGRESS_LINES"  # environment variable: a command writes its progress as lines for a program
LINE_START = "progress: "

Progress = Callable[[str, float], None]
"""Receives the present step in words and the share that is done, 0 ... 1."""


def part(progress: Progress, index: int, count: int) -> Progress:
    """Return the callback for one of `count` equal parts of the work."""
    return between(progress, index / count, (index + 1) / count)


def named(progress: Progress, name: str) -> Progress:
    """Return a callback that puts a name before each step."""
    return lambda text, fraction: progress(f"{name}: {text}", fraction)


def between(progress: Progress, first: float, last: float) -> Progress:
    """Return the callback for the share of the work from `first` to `last`."""
    return lambda text, fraction: progress(text, first + (last - first) * fraction)


def counting(items: Iterable[T], count: int, progress: Progress, text: str) -> Iterator[T]:
    """Yield `count` items, and report each when the next is asked for."""
    for done, item in enumerate(items, 1):
        yield item
        progress(text, done / count)


def counted(count: int, noun: str = "frame") -> str:
    """Return a count with its noun: "1 frame", "2 frames"."""
    return f"{count} {noun}{'s' * (count != 1)}"


def run_in_thread(work: Callable[[], T], name: str) -> tuple[Future[T], threading.Thread]:
    """Begin long work on a thread of its own; return the future of its result, and the thread."""
    future: Future[T] = Future()

    def run() -> None:
        try:
            result = work()
        except BaseException as error:  # noqa: BLE001 - the future passes it on
            future.set_exception(error)
        else:
            future.set_result(result)

    thread = threading.Thread(target=run, name=name, daemon=True)
    thread.start()
    return future, thread


class Evaluate(Protocol):
    """Calls a function with each item, and yields items with their results in any order."""

    def __call__(self, function: Callable[[T], R], items: Iterable[T]) -> Iterator[tuple[T, R | Exception]]:
        """Yield each item with the result or the error; take items from the iterable as they are needed."""
        ...
