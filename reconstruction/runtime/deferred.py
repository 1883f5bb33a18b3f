"""Values computed when they are first needed, and results that are remembered; both can be pickled."""

from collections.abc import Callable
from functools import lru_cache
from threading import Lock
from typing import Any, Generic, TypeVar, TypeVarTuple
from weakref import WeakMethod

A = TypeVarTuple("A")
M = TypeVar("M", bound=Callable[..., Any])
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


class Remembered(Generic[*A, R]):
    """A method that remembers its last results; they are not pickled.

    Its object is referred to weakly. It holds these results, tens of megabytes, and would else refer to itself: Python
    seldom looks for such objects, so that a process that prepares many reconstructions grew by gigabytes.
    """

    def __init__(self, method: Callable[[*A], R], most: int) -> None:
        """`most` results are kept."""
        weak = WeakMethod(method)
        self._method, self._most = weak, most

        def called(*args: *A) -> R:
            return _alive(weak)(*args)

        self._cached = lru_cache(maxsize=most)(called)

    def __call__(self, *args: *A) -> R:
        """The method's result."""
        return self._cached(*args)

    def __reduce__(self) -> tuple[type, tuple[Callable[[*A], R], int]]:
        return Remembered, (_alive(self._method), self._most)


def _alive(method: WeakMethod[M]) -> M:
    """Return the method of an object that exists."""
    found = method()
    if found is None:
        raise RuntimeError("the object of a remembered method is gone")
    return found
