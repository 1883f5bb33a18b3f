"""Memory of reconstructors that are no longer needed."""

from __future__ import annotations

import gc
import weakref
from collections.abc import Iterator

import pytest

import svwfs
from reconstruction.runtime.deferred import Remembered


@pytest.fixture
def _no_collector() -> Iterator[None]:
    gc.collect()
    gc.disable()
    yield
    gc.enable()


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.usefixtures("_no_collector")
def test_reconstructor_is_freed_at_once() -> None:
    """Python seldom looks for objects that refer to themselves: the study `photons` grew to 5 GB."""
    bench = svwfs.load_bench("small_demo")
    images = svwfs.simulate(bench)
    reconstruct = svwfs.reconstructor(bench, images.reference, dark=images.dark)
    refined = svwfs.refine(reconstruct, images.frames[0], 1)
    estimator = reconstruct._estimator
    assert estimator is not None
    parts = (reconstruct, estimator, estimator.reconstructor, estimator.refinement)
    left = [weakref.ref(part) for part in parts]
    del reconstruct, estimator, parts
    assert [ref() for ref in left] == [None] * 4
    assert refined.sigma().max() > 0  # the wavefront has what it needs


def test_remembered_method_remembers_its_last_results() -> None:
    class Squaring:
        def __init__(self) -> None:
            self.calls: list[int] = []
            self.square = Remembered(self._squared, 2)

        def _squared(self, number: int) -> int:
            self.calls.append(number)
            return number**2

    squaring = Squaring()
    assert [squaring.square(number) for number in (3, 4, 3, 5, 3, 4)] == [9, 16, 9, 25, 9, 16]
    assert squaring.calls == [3, 4, 5, 4]
