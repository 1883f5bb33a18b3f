"""How much each lenslet counts, where the weights can be told in closed form."""

from __future__ import annotations

import numpy as np

from reconstruction.solve.weights import SYSTEMATIC_PX, lenslet_weights, mean_variance


def test_a_lenslet_counts_less_where_its_frame_shows_more_error_and_never_more_where_it_shows_less() -> None:
    expected = np.array([1.0, 2.0, 1.0, 1.0, 1.0, 1.0, 4.0])
    of_frame = expected * np.array([1.0, 1.0, 16.0, 1 / 16, 1.9, 2.1, 1.0])  # less than half a step of four counts not
    weights = lenslet_weights(3.0 * of_frame, expected, 1.0)  # three times as much in all of them is the frame's own
    np.testing.assert_allclose(weights, [1.0, 0.5, 1 / 16, 1.0, 1.0, 1 / 4, 0.25])


def test_what_is_not_known_counts_nothing_and_does_not_change_the_others() -> None:
    nan, expected = np.nan, np.array([1.0, np.nan, 1.0, 1.0, 1.0])
    np.testing.assert_allclose(lenslet_weights(np.array([1, 1, nan, 1, 4.0]), expected, 1.0), [1, 0, 0, 1, 1 / 4])
    np.testing.assert_array_equal(lenslet_weights(np.full(5, nan), expected, 1.0), np.zeros(5))
    np.testing.assert_allclose(lenslet_weights(np.array([9.0]), np.array([2.0]), 1.0), [0.5])


def test_mean_variance_is_of_the_diagonals_both_axes_and_what_is_systematic() -> None:
    covariance = np.random.default_rng(0).normal(size=(4, 3, 2, 3, 2))
    covariance[2] = np.nan
    diagonal = np.einsum("lqaqa->lqa", covariance)
    np.testing.assert_allclose(mean_variance(covariance), diagonal.mean(axis=(1, 2)) + SYSTEMATIC_PX**2)
