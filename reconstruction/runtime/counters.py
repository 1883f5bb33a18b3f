"""Counters by which threads share items of compiled work without the interpreter lock."""

from collections.abc import Callable
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from reconstruction.runtime.compilation import compiled
from reconstruction.runtime.compiler import intrinsic, types

Counters = NDArray[np.int64]  # numbers of items taken and finished, (2,)

_SPINS = 20_000  # reads of the counters, about 0.1 ms, for which a thread spins until the others have finished


def new_counters() -> Counters:
    """No item taken, none finished."""
    return np.zeros(2, np.int64)


def _add_in_one_step(_context: Any, counters: Any, _entry: Any, _addend: Any) -> Any:
    """Describe to Numba how to add to an entry in one indivisible step and return the value before."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array = context.make_array(signature.args[0])(context, builder, arguments[0])
        return builder.atomic_rmw("add", builder.gep(array.data, [arguments[1]]), arguments[2], "seq_cst")

    return types.int64(counters, types.int64, types.int64), generate


_fetch_and_add = cast("Callable[[Counters, int, int], int]", intrinsic(_add_in_one_step))


@compiled
def take(counters: Counters) -> int:
    """Take the next item; from the number of items on, there are no more."""
    return _fetch_and_add(counters, 0, 1)


@compiled
def finish(counters: Counters) -> None:
    """Note that an item is finished."""
    _fetch_and_add(counters, 1, 1)


@compiled
def is_finished(counters: Counters, items: int) -> bool:
    """True if all items are finished, after a short wait for those in other threads."""
    for _ in range(_SPINS):  # noqa: SIM110 - Numba compiles no generator
        if _fetch_and_add(counters, 1, 0) >= items:
            return True
    return False
