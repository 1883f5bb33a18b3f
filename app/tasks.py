"""Independent tasks: done one after the other, or by workers (`app.batch.workers`)."""

from collections.abc import Callable, Iterable, Iterator
from typing import Protocol, TypeVar

T = TypeVar("T")
R = TypeVar("R")


class Evaluate(Protocol):
    """Calls a function with each item, and yields items with their results in any order."""

    def __call__(self, function: Callable[[T], R], items: Iterable[T]) -> Iterator[tuple[T, R | Exception]]:
        """Yield each item with the result or the error; take items from the iterable as they are needed."""
        ...


def one_by_one(function: Callable[[T], R], items: Iterable[T]) -> Iterator[tuple[T, R | Exception]]:
    """Call a function with each item in this process; see `Evaluate`."""
    for item in items:
        try:
            yield item, function(item)
        except Exception as error:  # noqa: BLE001 - the caller decides
            yield item, error
