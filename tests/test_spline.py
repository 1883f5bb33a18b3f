"""The B-spline against SciPy's, and the compiled one against the array one."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from reconstruction.kernel import interpolate
from reconstruction.spline import sample, spline_coefficients


def test_coefficients_are_scipys() -> None:
    image = np.random.default_rng(0).uniform(0, 1000, (40, 60)).astype(np.float32)
    np.testing.assert_allclose(spline_coefficients(image), ndimage.spline_filter(image, mode="mirror"), atol=1e-2)


def test_samples_are_scipys() -> None:
    rng = np.random.default_rng(1)
    image = rng.uniform(0, 1, (40, 60)).astype(np.float32)
    position = rng.uniform([0, 0], [59, 39], (200, 2))
    values, _ = sample(spline_coefficients(image), position)
    expected = ndimage.map_coordinates(image, [position[:, 1], position[:, 0]], order=3, mode="mirror")
    np.testing.assert_allclose(values, expected, atol=1e-5)


def test_gradients_are_those_of_the_values() -> None:
    rng = np.random.default_rng(2)
    coefficients = spline_coefficients(ndimage.gaussian_filter(rng.uniform(0, 1, (40, 60)), 2).astype(np.float32))
    position = rng.uniform([3, 3], [56, 36], (50, 2))
    _, gradients = sample(coefficients, position)
    step = 1e-5
    for axis in range(2):
        shift = step * np.eye(2)[axis]
        slope = (sample(coefficients, position + shift)[0] - sample(coefficients, position - shift)[0]) / (2 * step)
        np.testing.assert_allclose(gradients[:, axis], slope, atol=1e-6)


def test_compiled_interpolation_is_the_same() -> None:
    rng = np.random.default_rng(3)
    coefficients = spline_coefficients(rng.uniform(0, 1, (40, 60)).astype(np.float32))
    position = rng.uniform([2, 2], [56, 36], (100, 2)).astype(np.float32)
    compiled = [interpolate(coefficients, x, y) for x, y in position]
    np.testing.assert_allclose(compiled, sample(coefficients, position.astype(np.float64))[0], atol=2e-5)
