"""Camera noise: its model, and its measurement from the camera's own frames (photon transfer)."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import Floats, Image
from reconstruction.geometry import require

_FEWEST_FRAMES = 4  # with fewer, a pixel's variance is too uncertain
_BINS = 40  # of light, with equally many pixels


@dataclass(frozen=True, slots=True)
class CameraNoise:
    """Shot noise, amplified by the electron-multiplying register if there is one, and read noise."""

    counts_per_electron: float  # per photoelectron, including the register's gain
    read_noise_counts: float  # standard deviation of a dark pixel
    excess_noise: float = 1.0  # F^2, factor of the register on the shot-noise variance: 2 at high gain

    def __post_init__(self) -> None:
        require(
            {
                "counts_per_electron must be positive": 0 < self.counts_per_electron < math.inf,
                "read_noise_counts must be 0 or positive": 0 <= self.read_noise_counts < math.inf,
                "excess_noise must be 1 ... 2": 1 <= self.excess_noise <= 2,
            }
        )

    @property
    def counts_per_light(self) -> float:
        """Shot-noise variance (counts^2) per count of light."""
        return self.excess_noise * self.counts_per_electron

    def variance(self, light: NDArray[np.floating[Any]]) -> Floats:
        """Variance (counts^2) of pixels with that light (counts above the dark), of the same shape."""
        return np.asarray(self.counts_per_light * np.maximum(light, 0.0) + self.read_noise_counts**2, np.float64)


def photon_transfer(mean: Image, variance: Image, *, frames: int, dark_variance: Image) -> CameraNoise | None:
    """Measure the noise of one frame from the variance of each pixel against its light.

    The photon-transfer method (J. R. Janesick, Photon Transfer, SPIE 2007): the slope is the counts per photoelectron
    times the excess noise, the variance without light is the read noise. Medians over bins of equal light, corrected
    for the chi-square distribution of sample variances, reject hot pixels.

    Parameters
    ----------
    mean, variance : (row, column)
        Of each pixel over the `frames`, counts above the dark and counts^2.
    dark_variance : (row, column)
        The same without light, counts^2.

    Returns
    -------
    CameraNoise or None
        None if there are too few frames or too little light.
    """
    if frames < _FEWEST_FRAMES:
        return None
    scatter = _median_of_chi_square(frames - 1)
    read_variance = float(np.median(dark_variance)) / scatter
    order = np.argsort(mean, axis=None)
    light = np.array([np.mean(part) for part in np.array_split(mean.ravel()[order], _BINS)])
    noise = np.array([np.median(part) for part in np.array_split(variance.ravel()[order], _BINS)]) / scatter
    bright = light > np.max(light) / 10
    if np.min(noise[bright]) <= read_variance:
        return None
    # A line through the read noise, weighted because each bin's variance has the same relative error.
    weight = 1 / noise[bright] ** 2
    slope = float(
        np.sum(weight * light[bright] * (noise[bright] - read_variance)) / np.sum(weight * light[bright] ** 2)
    )
    return CameraNoise(counts_per_electron=slope, read_noise_counts=float(np.sqrt(read_variance)))


def _median_of_chi_square(degrees: int) -> float:
    """Median over mean of the chi-square distribution (Wilson and Hilferty 1931)."""
    return (1 - 2 / (9 * degrees)) ** 3
