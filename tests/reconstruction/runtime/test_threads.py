"""One BLAS thread in the whole process."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
import scipy.linalg
from support.paths import ROOT
from threadpoolctl import threadpool_info, threadpool_limits  # type: ignore[import-untyped] # ships no types

import svwfs
from app.bench.imaging_model import BenchModel
from reconstruction.layers.layer_search import search_layers
from reconstruction.reconstructor import Reconstructor
from reconstruction.runtime.threads import one_blas_thread


def blas_threads() -> set[int]:
    """Thread limits of the BLAS libraries in this process."""
    scipy.linalg.eigh(np.eye(2))
    return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}


def test_blas_limit_lasts_until_last_user_leaves() -> None:
    """Overlapping users, as when refinement ends during a replay."""
    with threadpool_limits(2, user_api="blas"):
        first, second = one_blas_thread(), one_blas_thread()
        first.__enter__()
        second.__enter__()
        assert blas_threads() == {1}
        first.__exit__(None, None, None)
        assert blas_threads() == {1}
        second.__exit__(None, None, None)
        assert blas_threads() == {2}


@pytest.mark.slow
def test_search_and_refinement_from_python_use_one_blas_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    """Threads of BLAS wait busily for one another: a frame took 13 s in place of 2."""
    bench = svwfs.load_bench("small_demo")
    images = svwfs.simulate(bench)
    reconstruct = svwfs.reconstructor(bench, images.reference, dark=images.dark)
    seen: dict[str, set[int]] = {}

    def watch(where: type, name: str) -> None:
        work = getattr(where, name)

        def watched(*args: Any, **named: Any) -> Any:
            seen[name] = blas_threads()
            return work(*args, **named)

        monkeypatch.setattr(where, name, watched)

    watch(Reconstructor, "register")
    watch(Reconstructor, "solve")
    watch(BenchModel, "image")
    monkeypatch.setattr("reconstruction.reconstructor.search_layers", partial(_noted, search_layers, seen))
    with threadpool_limits(2, user_api="blas"):
        reconstruct(images.frames[0])
        assert seen == {"register": {1}, "search_layers": {1}, "solve": {1}}
        seen.clear()
        svwfs.refine(reconstruct, images.frames[0], 1)
    assert seen["image"] == seen["search_layers"] == {1}


def _noted(work: Callable[..., Any], seen: dict[str, set[int]], *args: Any) -> Any:
    seen[work.__name__] = blas_threads()
    return work(*args)


def test_commands_limit_blas_before_it_is_loaded() -> None:
    code = (
        "import os, sys; import app.cli; loaded = 'numpy' in sys.modules; sys.argv = ['svwfs', '--help'];"
        "import atexit; atexit.register(lambda: print(loaded, os.environ['OPENBLAS_NUM_THREADS'])); app.cli.main()"
    )
    given = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}
    told = subprocess.run([sys.executable, "-c", code], cwd=ROOT, env=given, capture_output=True, text=True, check=True)  # noqa: S603 - our own
    assert told.stdout.splitlines()[-1] == "False 1"
