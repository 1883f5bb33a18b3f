"""Results kept in memory and on disk."""

from __future__ import annotations

import os
import subprocess
import sys
import weakref
from typing import Any

import numpy as np
import pytest

import app.cache
from app.cache import cache_folder, cached, kept_while_alive, release_memory


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


def test_cache_recomputes_damaged_and_drops_old_results(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []

    def compute() -> dict[str, Any]:
        calls.append(1)
        return {"value": np.array(len(calls))}

    folder = cache_folder() / "test-kind"
    assert [int(cached("test-kind", "a", compute)["value"]) for _ in range(2)] == [1, 1]
    (folder / "a.npz").write_bytes(b"PK nonsense")
    assert int(cached("test-kind", "a", compute)["value"]) == 2
    monkeypatch.setattr(app.cache, "_KEPT", 1)
    os.utime(folder / "a.npz", (0, 0))
    cached("test-kind", "b", compute)
    assert [path.name for path in folder.glob("*")] == ["b.npz"]


@pytest.mark.skipif(sys.platform != "linux", reason="asks the GNU library")
@pytest.mark.parametrize("is_shared", [True, False])
def test_threads_of_a_window_allocate_from_two_places(is_shared: bool) -> None:
    """Without that, each of ten analyses has a place of its own, and a window grows with each bench."""
    code = f"""
import ctypes, threading
from app.cache import share_memory_of_threads
if {is_shared}:
    share_memory_of_threads()
libc, barrier = ctypes.CDLL(None), threading.Barrier(9)
def work():
    kept = [bytearray(1000) for _ in range(1000)]
    barrier.wait()
    barrier.wait()
threads = [threading.Thread(target=work) for _ in range(8)]
for thread in threads:
    thread.start()
barrier.wait()
libc.malloc_info(0, ctypes.c_void_p.in_dll(libc, "stdout"))
libc.fflush(None)
barrier.wait()
"""
    made = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)  # noqa: S603 - this interpreter
    assert (made.stdout.count("<heap nr=") <= 2) is is_shared
