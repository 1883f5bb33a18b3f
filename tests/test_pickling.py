"""Wavefronts and reconstructors in other processes."""

from __future__ import annotations

import copy
import multiprocessing
import pickle

import dask.bag as dask_bag
import numpy as np
import pytest

import svwfs
from app.evaluation.frames import SimulatedFrames
from app.measurement.offline_reconstructor import OfflineReconstructor
from reconstruction.wavefront import Wavefront

METHODS = ["sample=automatic", "sample=free", "method=zonal", "pupil_modes=21"]


def prepared(setting: str) -> tuple[OfflineReconstructor, SimulatedFrames]:
    bench = svwfs.load_bench("small_demo", f"reconstruction.{setting}")
    images = svwfs.simulate(bench, frames=2)
    return svwfs.reconstructor(bench, images.reference, dark=images.dark), images


def require_same(one: Wavefront, other: Wavefront) -> None:
    np.testing.assert_array_equal(one.views, other.views)
    np.testing.assert_array_equal(one.sigma(), other.sigma())
    np.testing.assert_array_equal(one.displacement.covariance, other.displacement.covariance)
    assert svwfs.to_dataset(one).equals(svwfs.to_dataset(other))


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize("setting", METHODS)
def test_wavefront_and_reconstructor_survive_pickling(setting: str) -> None:
    reconstruct, images = prepared(setting)
    wavefront = reconstruct(images.frames[0])
    require_same(pickle.loads(pickle.dumps(wavefront)), wavefront)  # noqa: S301 - our own
    require_same(copy.deepcopy(wavefront), wavefront)
    refined = svwfs.refine(reconstruct, images.frames[0], 1)
    sentence = reconstruct.quality(images.frames[0], wavefront).sentence
    again = pickle.loads(pickle.dumps(reconstruct))  # noqa: S301 - our own
    require_same(again(images.frames[0]), wavefront)
    require_same(svwfs.refine(again, images.frames[0], 1), refined)
    assert again.quality(images.frames[0], wavefront).sentence == sentence


def test_pickled_wavefront_is_small() -> None:
    """It holds its own error bars, but nothing of the reconstructor, which has some 10 MB."""
    reconstruct, images = prepared("sample=automatic")
    wavefront = reconstruct(images.frames[0])
    assert len(pickle.dumps(wavefront)) < 1e6 < len(pickle.dumps(reconstruct))


@pytest.mark.slow
@pytest.mark.long
def test_other_processes_reconstruct_the_same() -> None:
    reconstruct, images = prepared("sample=automatic")
    expected = [reconstruct(frame) for frame in images.frames]
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        of_pool = pool.map(reconstruct, list(images.frames))
    bag = dask_bag.from_sequence(list(images.frames))  # type: ignore[no-untyped-call] # Dask has few annotations
    of_dask = bag.map(reconstruct).compute(scheduler="processes")
    for wavefront, *others in zip(expected, of_pool, of_dask, strict=True):
        for other in others:
            require_same(other, wavefront)
