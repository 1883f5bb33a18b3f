"""Blur of interpolation against SciPy's spline interpolation at many fractions of a pixel."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from reconstruction.arrays import Floats
from reconstruction.frame.spline import mean_interpolation

PIXELS = 48
AT = np.arange(PIXELS, dtype=np.float64)


def bright_line(x: Floats) -> Floats:
    """Two lines of light as narrow as pixels can show, and a wide one; dark at both ends."""
    lines = np.exp(-(((x - 17.3) / 2.2) ** 2)) - 0.6 * np.exp(-(((x - 28.9) / 2.4) ** 2))
    return np.asarray(lines + 0.3 * np.exp(-(((x - 22) / 4) ** 2)))


def resampled(away_px: float) -> Floats:
    """Values at the pixels, interpolated from a camera whose pixels lie beside them by a fraction."""
    lines = []
    for fraction in (np.arange(64) + 0.5) / 64:
        seen = bright_line(AT + fraction)
        lines.append(ndimage.map_coordinates(seen, [AT - fraction + away_px], order=3, mode="constant"))
    return np.asarray(np.mean(lines, axis=0))


def test_values_are_means_over_all_fractions_of_a_pixel() -> None:
    values, _ = mean_interpolation(PIXELS)
    expected = resampled(0.0)
    np.testing.assert_allclose(values @ bright_line(AT), expected, atol=3e-6)
    assert np.abs(expected - bright_line(AT)).max() > 5e-4  # of which this is the blur


def test_slopes_are_those_of_the_interpolated_line() -> None:
    _, slopes = mean_interpolation(PIXELS)
    step = 1e-3
    expected = (resampled(step) - resampled(-step)) / (2 * step)
    np.testing.assert_allclose(slopes @ bright_line(AT), expected, atol=3e-5)
    exact = (bright_line(AT + step) - bright_line(AT - step)) / (2 * step)
    assert np.abs(expected - exact).max() > 5e-4


def test_smooth_light_is_not_blurred() -> None:
    values, slopes = mean_interpolation(PIXELS)
    wide = np.exp(-(((AT - 24) / 5) ** 2))
    np.testing.assert_allclose(values @ wide, wide, atol=2e-4)
    np.testing.assert_allclose(slopes @ wide, -2 * (AT - 24) / 25 * wide, atol=2e-4)
