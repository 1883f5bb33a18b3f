"""Compiled loops share items among threads without the interpreter lock: each thread takes the next until none is left.

A thread that starts late, because others hold the lock or the processor is busy, delays nobody.
"""

from collections.abc import Callable
from typing import Any, cast

import numpy as np
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from reconstruction.runtime.compilation import compiled

Ledger = NDArray[np.int64]  # numbers of items taken and finished, (2,)

_PATIENCE = 20_000  # reads of the ledger, about 0.1 ms, for which a thread spins until the others have finished


def new_ledger() -> Ledger:
    """No item taken, none finished."""
    return np.zeros(2, np.int64)


def _add_in_one_step(_context: Any, ledger: Any, _entry: Any, _addend: Any) -> Any:
    """Describe to Numba how to add to an entry in one indivisible step and return the value before."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array = context.make_array(signature.args[0])(context, builder, arguments[0])
        return builder.atomic_rmw("add", builder.gep(array.data, [arguments[1]]), arguments[2], "seq_cst")

    return types.int64(ledger, types.int64, types.int64), generate


_fetch_and_add = cast("Callable[[Ledger, int, int], int]", intrinsic(_add_in_one_step))


@compiled
def take(ledger: Ledger) -> int:
    """Take the next item; from the number of items on, there are no more."""
    return _fetch_and_add(ledger, 0, 1)


@compiled
def finish(ledger: Ledger) -> None:
    """Note that an item is finished."""
    _fetch_and_add(ledger, 1, 1)


@compiled
def is_finished(ledger: Ledger, items: int) -> bool:
    """Return whether all items are finished, after a short wait for those in other threads."""
    for _ in range(_PATIENCE):  # noqa: SIM110 - Numba compiles no generator
        if _fetch_and_add(ledger, 1, 0) >= items:
            return True
    return False
