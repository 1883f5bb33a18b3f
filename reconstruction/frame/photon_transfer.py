"""The camera's noise as its own frames show it: the variance of each pixel against the light on it.

The photon-transfer method (J. R. Janesick, Photon Transfer, SPIE 2007): the slope is the counts of a photoelectron,
times the excess noise of an electron-multiplying register; what is left without light is the read noise. So no data
sheet is needed, whatever camera, amplifier and gain.
"""

from __future__ import annotations

import numpy as np

from reconstruction.arrays import Image
from reconstruction.frame.noise import CameraNoise

_FEWEST_FRAMES = 4  # with fewer, a pixel's variance is too uncertain to be of use
_BINS = 40  # of light, equally many pixels in each


def photon_transfer(mean: Image, variance: Image, *, frames: int, dark_variance: Image) -> CameraNoise | None:
    """Noise of one frame from the mean of some frames, counts above the dark, and each pixel's variance among them.

    All are (row, column); `dark_variance` is that of the frames without light. The median over each bin of light, put
    right for how variances of few frames scatter, is not misled by hot pixels. None where the frames cannot tell.
    """
    if frames < _FEWEST_FRAMES:
        return None
    scatter = _median_of_chi_square(frames - 1)
    read_variance = float(np.median(dark_variance)) / scatter
    order = np.argsort(mean, axis=None)
    light = np.array([np.mean(part) for part in np.array_split(mean.ravel()[order], _BINS)])
    noise = np.array([np.median(part) for part in np.array_split(variance.ravel()[order], _BINS)]) / scatter
    bright = light > np.max(light) / 10
    # A line through the read noise; a bin's variance is known to a fixed fraction, hence the weights.
    if np.min(noise[bright]) <= read_variance:
        return None
    weight = 1 / noise[bright] ** 2
    slope = float(
        np.sum(weight * light[bright] * (noise[bright] - read_variance)) / np.sum(weight * light[bright] ** 2)
    )
    return CameraNoise(counts_per_electron=slope, read_noise_counts=float(np.sqrt(read_variance)))


def _median_of_chi_square(degrees: int) -> float:
    """Median over mean of the chi-square distribution (Wilson and Hilferty 1931)."""
    return (1 - 2 / (9 * degrees)) ** 3
