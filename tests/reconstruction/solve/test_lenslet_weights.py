"""Lenslet weights in closed form."""

from __future__ import annotations

import numpy as np

from reconstruction.displacement import SYSTEMATIC_PX
from reconstruction.solve.weights import lenslet_weights, mean_variance


def test_noisier_frame_lowers_weight_and_never_raises_it() -> None:
    expected = np.array([1.0, 2.0, 1.0, 1.0, 1.0, 1.0, 4.0])
    of_frame = expected * np.array([1.0, 1.0, 16.0, 1 / 16, 1.9, 2.1, 1.0])  # less than half a step has no effect
    weights = lenslet_weights(3.0 * of_frame, expected, 1.0)  # a common factor of 3 has no effect
    np.testing.assert_allclose(weights, [1.0, 0.5, 1 / 16, 1.0, 1.0, 1 / 4, 0.25])


def test_unknown_variance_has_zero_weight_and_no_influence() -> None:
    nan, expected = np.nan, np.array([1.0, np.nan, 1.0, 1.0, 1.0])
    np.testing.assert_allclose(lenslet_weights(np.array([1, 1, nan, 1, 4.0]), expected, 1.0), [1, 0, 0, 1, 1 / 4])
    np.testing.assert_array_equal(lenslet_weights(np.full(5, nan), expected, 1.0), np.zeros(5))
    np.testing.assert_allclose(lenslet_weights(np.array([9.0]), np.array([2.0]), 1.0), [0.5])


def test_mean_variance_averages_diagonal_and_adds_systematic_error() -> None:
    covariance = np.random.default_rng(0).normal(size=(4, 3, 2, 3, 2))
    covariance[2] = np.nan
    diagonal = np.einsum("lqaqa->lqa", covariance)
    np.testing.assert_allclose(mean_variance(covariance), diagonal.mean(axis=(1, 2)) + SYSTEMATIC_PX**2)
