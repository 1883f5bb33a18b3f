"""The error bars against the scatter of many noisy frames."""

from __future__ import annotations

import numpy as np
from optics import SmallBench

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
    assert 0.85 < np.sqrt(np.mean(ratio**2)) < 1.35
