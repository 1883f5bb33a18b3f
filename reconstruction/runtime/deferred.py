"""Values computed when they are first needed, and results that are remembered; both can be pickled."""

from collections.abc import Callable
from functools import cached_property, lru_cache
from typing import Generic, TypeVar, TypeVarTuple

A = TypeVarTuple("A")
R = TypeVar("R")


class Deferred(Generic[R]):
    """A value that is computed when it is first called for, or when it is pickled."""

    def __init__(self, compute: Callable[[], R]) -> None:
        self._compute = compute

    def __call__(self) -> R:
        """The value."""
        return self._value

    @cached_property
    def _value(self) -> R:
        return self._compute()

    def __getstate__(self) -> dict[str, R]:
        return {"_value": self._value}


class Remembered(Generic[*A, R]):
    """A method that remembers its last results; they are not pickled."""

    def __init__(self, method: Callable[[*A], R], most: int) -> None:
        """`most` results are kept."""
        self._method, self._most = method, most
        self._cached = lru_cache(maxsize=most)(method)

    def __call__(self, *args: *A) -> R:
        """The method's result."""
        return self._cached(*args)

    def __reduce__(self) -> tuple[type, tuple[Callable[[*A], R], int]]:
        return Remembered, (self._method, self._most)
