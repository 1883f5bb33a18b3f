"""Array types, medians, and the reading of NumPy's files, shared by the packages."""

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from tokenize import TokenError
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Image = NDArray[np.float32]
Counts = NDArray[np.integer[Any]] | NDArray[np.floating[Any]]
"""Camera frame as read from a camera or a file, (row, column)."""
Booleans = NDArray[np.bool_]
PointField = Callable[[float, float], NDArray[np.complex64]]
"""Field at the pupil samples, (sample_row, sample_column), that the object point (x_m, y_m) has behind the sample.

It has no tilt of its own, and is 1 without a sample.
"""

SIGMA_OF_MEDIAN = 1.4826  # standard deviation of normal noise over the median of its magnitude


def median(values: NDArray[np.floating[Any]]) -> float:
    """Median of known values (N,), N > 0; for few of them much faster than NumPy's."""
    upper = values.size // 2
    lower = upper - 1 + values.size % 2
    parted = np.partition(values, (lower, upper))
    return float(parted[lower] + parted[upper]) / 2


@contextmanager
def reading_npy() -> Iterator[None]:
    """Turn what `np.load` raises and warns of a damaged header into a `ValueError`."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            yield
        except (TokenError, SyntaxError, OverflowError) as error:
            raise ValueError(f"its header is damaged: {error}") from error
