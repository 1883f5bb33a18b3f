"""BLAS in one thread, whoever asks for it, and however they come and go."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg
from threadpoolctl import threadpool_info, threadpool_limits  # type: ignore[import-untyped] # ships no types

from reconstruction.threads import one_blas_thread


def blas_threads() -> set[int]:
    """How many threads each BLAS in this program may use."""
    scipy.linalg.eigh(np.eye(2))
    return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}


def test_the_limit_lasts_until_the_last_has_left() -> None:
    """As when refinement ends late: it began before a replay, and leaves in the middle of it."""
    with threadpool_limits(2, user_api="blas"):
        first, second = one_blas_thread(), one_blas_thread()
        first.__enter__()
        second.__enter__()
        assert blas_threads() == {1}
        first.__exit__(None, None, None)
        assert blas_threads() == {1}
        second.__exit__(None, None, None)
        assert blas_threads() == {2}


def test_an_error_takes_the_limit_away_too() -> None:
    with threadpool_limits(2, user_api="blas"):
        with pytest.raises(ValueError, match="wrong"), one_blas_thread():
            raise ValueError("wrong")
        assert blas_threads() == {2}
