"""Memory of reconstructors that are no longer needed."""

from __future__ import annotations

import gc
import weakref
from collections.abc import Iterator

import pytest

import svwfs


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
