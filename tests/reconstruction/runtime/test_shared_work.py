"""Sharing of a compiled loop's items among threads."""

from __future__ import annotations

import threading

import numpy as np
from numpy.typing import NDArray

from reconstruction.registration.gauss_newton._lenslet_fits import Counters, finish, is_finished, new_counters, take
from reconstruction.runtime.compilation import compiled


@compiled
def count_items(times: NDArray[np.int64], counters: Counters) -> bool:
    """Count how often each item is taken."""
    while True:
        item = take(counters)
        if item >= times.size:
            return is_finished(counters, times.size)
        times[item] += 1
        finish(counters)


def test_every_item_is_taken_once() -> None:
    times, counters = np.zeros(200_000, np.int64), new_counters()
    count_items(np.zeros(1, np.int64), new_counters())  # compiled before the threads race
    ready = threading.Barrier(4)

    def work() -> None:
        ready.wait()
        count_items(times, counters)

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert (times == 1).all()
    assert is_finished(counters, times.size)


def test_item_of_another_thread_is_waited_for() -> None:
    counters = new_counters()
    assert take(counters) == 0  # by another thread, which has not finished it
    assert not count_items(np.zeros(3, np.int64), counters)
    finish(counters)
    assert is_finished(counters, 3)
