"""Values computed when they are first needed, and results that are remembered; both can be pickled."""

from collections import OrderedDict
from collections.abc import Callable
from contextlib import suppress
from threading import Lock
from typing import Any, Generic, TypeVar, TypeVarTuple

A = TypeVarTuple("A")
R = TypeVar("R")


class Deferred(Generic[R]):
    """A value that is computed when it is first called for, or when it is pickled."""

    def __init__(self, compute: Callable[[], R]) -> None:
        # Not a cached property: before Python 3.12 all of a class wait for the one that is being computed.
        self._compute, self._lock = compute, Lock()

    def __call__(self) -> R:
        """The value."""
        if not hasattr(self, "_value"):
            with self._lock:
                if not hasattr(self, "_value"):
                    self._value = self._compute()
        return self._value

    def __getstate__(self) -> dict[str, R]:
        return {"_value": self()}


class Remembered(Generic[R]):
    """The last results of a function, by its arguments; they are not pickled.

    It does not refer to the function: a method's object would refer to itself, and to tens of megabytes of results.
    Python seldom frees such objects.
    """

    def __init__(self, most: int) -> None:
        """`most` results are retained."""
        self._most, self._results = most, OrderedDict[tuple[Any, ...], R]()

    def __call__(self, function: Callable[[*A], R], *args: *A) -> R:
        """The result of the function, which is always the same one."""
        found = self._results.get(args)
        if found is None:
            found = self._results[args] = function(*args)
            if len(self._results) > self._most:
                self._results.popitem(last=False)
        else:
            with suppress(KeyError):  # another thread has just dropped it
                self._results.move_to_end(args)
        return found

    def __reduce__(self) -> tuple[type, tuple[int]]:
        return Remembered, (self._most,)
