"""Statistics of arrays."""

import numpy as np
import pytest

from reconstruction.arrays import median


@pytest.mark.parametrize("count", [1, 2, 3, 4, 9, 64, 225])
def test_median_is_that_of_numpy(count: int) -> None:
    values = np.random.default_rng(count).normal(size=count)
    before = values.copy()
    assert median(values) == np.median(values)
    np.testing.assert_array_equal(values, before)
