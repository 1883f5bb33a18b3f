"""Results kept in memory."""

from __future__ import annotations

import weakref

from app.cache import kept_while_alive, release_memory


class Bench:
    """What results are of."""


def test_results_are_kept_as_long_as_their_bench_lives() -> None:
    """Also if they were computed when the bench was closed already."""
    calls: list[int] = []

    @kept_while_alive(maxsize=2)
    def computed(_: Bench, number: int) -> Bench:
        calls.append(number)
        return Bench()

    first, second = Bench(), Bench()
    assert computed(first, 1) is computed(first, 1) is not computed(second, 1)
    assert computed(first, 2) is computed(first, 2)
    assert calls == [1, 1, 2]
    result = weakref.ref(computed(first, 1))
    release_memory()
    assert result() is computed(first, 1)
    del first
    assert result() is None


def test_only_the_last_benches_have_their_results_kept() -> None:
    @kept_while_alive(maxsize=2)
    def computed(_: Bench) -> Bench:
        return Bench()

    benches = [Bench() for _ in range(3)]
    first = weakref.ref(computed(benches[0]))
    computed(benches[1])
    assert first() is not None
    computed(benches[2])
    assert first() is None
