"""B-splines against SciPy, and the compiled sampling against the array one."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from scipy import ndimage

from reconstruction.frame.spline import interpolate, interpolate_evenly, shared_coefficients, spline_coefficients
from reconstruction.registration.gauss_newton._warped_sampling import new_scratch, sample_warped, window_of


@pytest.mark.parametrize("shape", [(40, 60), (3, 40), (8, 8), (64, 9), (150, 2), (1, 1), (1, 30), (30, 1), (2, 2)])
def test_coefficients_match_scipy(shape: tuple[int, int]) -> None:
    image = np.random.default_rng(0).uniform(0, 1000, shape).astype(np.float32)
    np.testing.assert_allclose(spline_coefficients(image), ndimage.spline_filter(image, mode="mirror"), atol=1e-2)


@pytest.mark.parametrize("kind", ["u1", "<u2", ">u2", ">f4", "f8"])
def test_coefficients_do_not_depend_on_dtype_or_memory_order(kind: str) -> None:
    counts = np.random.default_rng(7).integers(0, 256, (70, 90))
    expected = spline_coefficients(counts.astype(np.float32))
    image = counts.astype(kind)
    turned, wide = np.asfortranarray(image), np.repeat(image, 2, axis=1)[:, ::2]
    image.flags.writeable = False
    for each in (image, turned, wide, image[::-1][::-1]):
        before = each.copy()
        np.testing.assert_array_equal(spline_coefficients(each), expected)
        np.testing.assert_array_equal(each, before)


def test_samples_match_scipy() -> None:
    rng = np.random.default_rng(1)
    image = rng.uniform(0, 1, (40, 60)).astype(np.float32)
    position = rng.uniform([0, 0], [59, 39], (200, 2))
    values, _ = interpolate(spline_coefficients(image), position)
    expected = ndimage.map_coordinates(image, [position[:, 1], position[:, 0]], order=3, mode="mirror")
    np.testing.assert_allclose(values, expected, atol=1e-5)


@pytest.mark.parametrize("shape", [(40, 60), (3, 5)])
def test_samples_on_a_turned_grid_match_scipy_also_beyond_the_borders(shape: tuple[int, int]) -> None:
    image = np.random.default_rng(6).uniform(0, 1, shape).astype(np.float32)
    start_px, steps_px = np.array([-4.3, 2.6]), np.array([[1.1, -0.2], [0.3, 0.9]])
    samples = interpolate_evenly(spline_coefficients(image), start_px, steps_px, (50, 70))
    row, column = np.indices(samples.shape)
    x, y = (start_px[axis] + column * steps_px[0, axis] + row * steps_px[1, axis] for axis in range(2))
    expected = ndimage.map_coordinates(image, [y, x], order=3, mode="mirror")
    np.testing.assert_allclose(samples, expected, atol=1e-5)


def test_gradients_match_numerical_derivatives() -> None:
    rng = np.random.default_rng(2)
    coefficients = spline_coefficients(ndimage.gaussian_filter(rng.uniform(0, 1, (40, 60)), 2).astype(np.float32))
    position = rng.uniform([3, 3], [56, 36], (50, 2))
    _, gradients = interpolate(coefficients, position)
    step = 1e-5
    for axis in range(2):
        shift = step * np.eye(2)[axis]
        slope = (interpolate(coefficients, position + shift)[0] - interpolate(coefficients, position - shift)[0]) / (
            2 * step
        )
        np.testing.assert_allclose(gradients[:, axis], slope, atol=1e-6)


def test_compiled_warp_sampling_matches_scipy_and_determinant() -> None:
    rng = np.random.default_rng(3)
    coefficients = spline_coefficients(rng.uniform(0, 1, (40, 60)).astype(np.float32))
    steps = rng.uniform(-1, 1, 10).astype(np.float32)
    u, v = (grid.ravel() for grid in np.meshgrid(steps.astype(np.float64), steps.astype(np.float64)))
    polynomials = rng.uniform(-0.4, 0.4, (2, 15)).astype(np.float32)
    powers = np.array([[degree - n, n] for degree in range(5) for n in range(degree + 1)])
    monomial = u[:, None] ** powers[:, 0] * v[:, None] ** powers[:, 1]
    scratch = new_scratch(100, 0)
    scratch.warp[:] = polynomials
    center_px, turn, per_unit = np.array([30.3, 19.8]), np.array([np.cos(0.1), np.sin(0.1)], np.float32), 9.0
    scale = (np.float32(per_unit), np.float32(1 / per_unit))
    window = window_of(np.ones((10, 10), np.bool_), steps)
    sample_warped(coefficients, window, center_px, turn, scale, scratch)
    along, across = np.array([u, v]) * per_unit + polynomials @ monomial.T
    x, y = 30.3 + turn[0] * along - turn[1] * across, 19.8 + turn[1] * along + turn[0] * across
    by_u = np.where(powers[:, 0] > 0, powers[:, 0] * u[:, None] ** np.maximum(powers[:, 0] - 1, 0), 0)
    by_v = np.where(powers[:, 1] > 0, powers[:, 1] * v[:, None] ** np.maximum(powers[:, 1] - 1, 0), 0)
    slope_u = polynomials @ (by_u * v[:, None] ** powers[:, 1]).T / per_unit
    slope_v = polynomials @ (by_v * u[:, None] ** powers[:, 0]).T / per_unit
    stretch = (1 + slope_u[0]) * (1 + slope_v[1]) - slope_v[0] * slope_u[1]
    light = ndimage.map_coordinates(coefficients, [y, x], np.float64, order=3, mode="mirror", prefilter=False)
    np.testing.assert_allclose(scratch.light, light, atol=5e-5)
    np.testing.assert_allclose(scratch.stretch, stretch, atol=1e-5)


@pytest.mark.parametrize("threads", [2, 3])
def test_coefficients_do_not_depend_on_threads(threads: int) -> None:
    image = np.random.default_rng(5).normal(100, 30, (1001, 803)).astype(np.float32)
    coefficients, share = shared_coefficients(image)
    with ThreadPoolExecutor(threads) as pool:
        for each in [pool.submit(share) for _ in range(threads)]:
            each.result()
    np.testing.assert_array_equal(coefficients, spline_coefficients(image))


def test_interrupted_thread_is_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    image = np.random.default_rng(5).normal(100, 30, (301, 203)).astype(np.float32)
    expected = spline_coefficients(image)
    counters = iter([np.array([1, 0]), np.zeros(2, np.int64)])  # another thread has taken the first strip
    monkeypatch.setattr("reconstruction.frame.spline.new_counters", lambda: next(counters))
    coefficients, share = shared_coefficients(image)
    coefficients[:] = np.nan
    share()
    np.testing.assert_array_equal(coefficients, expected)
