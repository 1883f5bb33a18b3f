"""Lenslet weights in closed form."""

from __future__ import annotations

import numpy as np

from reconstruction.solve.expected_errors import relative_weights


def test_noisier_frame_lowers_weight_and_never_raises_it() -> None:
    expected = np.array([1.0, 2.0, 1.0, 1.0, 1.0, 1.0, 4.0])
    of_frame = expected * np.array([1.0, 1.0, 16.0, 1 / 16, 1.9, 2.1, 1.0])  # less than half a step has no effect
    weights = relative_weights(3.0 * of_frame, expected)  # a common factor of 3 has no effect
    np.testing.assert_allclose(weights, [1.0, 1.0, 1 / 16, 1.0, 1.0, 1 / 4, 1.0])


def test_unknown_variance_has_zero_weight_and_no_influence() -> None:
    nan, expected = np.nan, np.array([1.0, np.nan, 1.0, 1.0, 1.0])
    np.testing.assert_allclose(relative_weights(np.array([1, 1, nan, 1, 4.0]), expected), [1, 0, 0, 1, 1 / 4])
    np.testing.assert_array_equal(relative_weights(np.full(5, nan), expected), np.zeros(5))
    np.testing.assert_allclose(relative_weights(np.array([9.0]), np.array([2.0])), [1.0])
