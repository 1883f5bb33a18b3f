"""The error bars against the scatter of many noisy frames; the noise of interpolation against SciPy."""

from __future__ import annotations

import numpy as np
from optics import SmallBench
from scipy import ndimage

from reconstruction.spline import noise_power

DRAWS = 60


def test_coefficients_scatter_as_their_sigma_says(small_bench: SmallBench) -> None:
    u, v = small_bench.samples()
    frame = small_bench.frame(lambda x, _y: (1500.0 * u + 500.0 * v + 4e5 * u * x).astype(np.float32))
    reconstructor = small_bench.reconstructor("quadratic", pupil_modes=15)
    generator = np.random.default_rng(0)
    noise = 0.01 * float(frame.max())
    solutions = [
        reconstructor(frame + generator.normal(0, noise, frame.shape).astype(np.float32)).solution for _ in range(DRAWS)
    ]
    coefficients = np.array([solution.coefficients for solution in solutions])  # type: ignore[attr-defined] # modal
    sigma = np.array([solution.sigma for solution in solutions]).mean(axis=0)  # type: ignore[attr-defined] # the same
    ratio = coefficients.std(axis=0, ddof=1)[1:] / sigma[1:]  # the piston has neither
    assert 0.9 < np.sqrt(np.mean(ratio**2)) < 1.1


def test_interpolated_noise_is_as_weak_as_scipys() -> None:
    noise = np.random.default_rng(0).normal(size=(400, 400))
    y, x = np.meshgrid(np.arange(20, 380), np.arange(20, 380), indexing="ij")
    for fraction_x, fraction_y in ((0.0, 0.0), (0.5, 0.0), (0.25, 0.5), (0.5, 0.5)):
        values = ndimage.map_coordinates(noise, [y + fraction_y, x + fraction_x], order=3, mode="mirror")
        expected = values.var() / noise.var()
        np.testing.assert_allclose(noise_power(np.array([7 + fraction_x, 3 + fraction_y])), expected, rtol=0.02)
