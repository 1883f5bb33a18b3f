"""The noise of the camera: what its pixels scatter by, from the light that falls on them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import Floats
from reconstruction.geometry import require


@dataclass(frozen=True, slots=True)
class CameraNoise:
    """Shot noise, multiplied by the electron-multiplying register if there is one, and read noise."""

    counts_per_electron: float  # of the photoelectrons, the register's gain included
    read_noise_counts: float
    excess_noise: float = 1.0  # F^2, by how much the register's own chance adds to the shot noise: 2 with gain, else 1

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
        """Variance (counts^2) that each count of light adds: of the shot noise, behind the register."""
        return self.excess_noise * self.counts_per_electron

    def variance(self, light: NDArray[np.floating[Any]]) -> Floats:
        """Variance of a pixel, counts^2, where the light is `light` (...), counts above the dark."""
        return np.asarray(self.counts_per_light * np.maximum(light, 0.0) + self.read_noise_counts**2, np.float64)
