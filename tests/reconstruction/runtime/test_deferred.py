"""A deferred value is computed once, by the first thread that reads it, and waits for no other value."""

from __future__ import annotations

import pickle
import threading
import time
from concurrent.futures import ThreadPoolExecutor

from support.patience import HANG_S

from reconstruction.runtime.deferred import Deferred


def test_value_is_computed_once_by_many_threads() -> None:
    computed: list[int] = []

    def compute() -> int:
        time.sleep(0.05)
        computed.append(1)
        return 7

    value = Deferred(compute)
    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(lambda _: value(), range(8))) == [7] * 8
    assert computed == [1]
    assert pickle.loads(pickle.dumps(value))() == 7  # noqa: S301 - our own


def test_a_value_does_not_wait_for_another_that_is_computed() -> None:
    """A frame waited for layers that were being prepared: before Python 3.12 a cached property has one lock for all."""
    begun, may_end = threading.Event(), threading.Event()

    def compute_slowly() -> str:
        begun.set()
        assert may_end.wait(HANG_S)
        return "slow"

    slow = Deferred(compute_slowly)
    with ThreadPoolExecutor(2) as pool:
        waiting = pool.submit(slow)
        assert begun.wait(HANG_S)
        try:
            assert pool.submit(Deferred(lambda: "quick")).result(HANG_S) == "quick"
        finally:
            may_end.set()
        assert waiting.result(HANG_S) == "slow"
