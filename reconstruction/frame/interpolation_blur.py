"""Blur of images by spline interpolation, averaged over fractions of a pixel.

Interpolation at the fraction f of a pixel multiplies the wave exp(2 pi i nu x) by
sum_j B(j - f) exp(2 pi i nu (j - f)) / sum_j B(j) exp(2 pi i nu j), B the cubic B-spline. The mean over all fractions
is sinc(nu)^4 / ((2 + cos(2 pi nu)) / 3).
"""

import numpy as np
from scipy.linalg import toeplitz

from reconstruction.arrays import Floats

_WAVES = 256


def mean_interpolation(pixels: int) -> tuple[Floats, Floats]:
    """Values and slopes of lines of pixels after interpolation at random fractions: matrices (pixel, pixel).

    Beyond its ends a line is dark.
    """
    cycles_per_px = (np.arange(_WAVES) + 0.5) / (2 * _WAVES)
    transfer = np.sinc(cycles_per_px) ** 4 / ((2 + np.cos(2 * np.pi * cycles_per_px)) / 3)
    angle = 2 * np.pi * cycles_per_px * np.arange(pixels)[:, None]
    values = np.mean(transfer * np.cos(angle), axis=1)
    slopes = -np.mean(transfer * 2 * np.pi * cycles_per_px * np.sin(angle), axis=1)
    return toeplitz(values), toeplitz(slopes, -slopes)
