"""Aperture of a lenslet."""

import math

import numpy as np

from reconstruction.arrays import Floats
from reconstruction.geometry import Arrangement, centered_steps

_PARTS = 16  # of a sample, along each axis


def lenslet_aperture(arrangement: Arrangement, pupil_samples: int) -> Floats:
    """Share of each sample about a lenslet that lies in its aperture, (sample_row, sample_column).

    The samples, `pupil_samples` or a few more to a pitch, fill a square of `Sensor.aperture_width_m`. A square lattice
    has square lenslets, a hexagonal one hexagons that tile it, with corners at +-y.
    """
    if arrangement == "square":
        return np.ones((pupil_samples, pupil_samples))
    samples = 2 * math.ceil(pupil_samples / math.sqrt(3))
    along = np.abs(centered_steps(samples * _PARTS)) / (samples * _PARTS)  # over the whole width
    inside = (along <= np.sqrt(3) / 4) & (along[:, None] <= 0.5 - along / np.sqrt(3))
    return np.asarray(inside.reshape(samples, _PARTS, samples, _PARTS).mean(axis=(1, 3)))
