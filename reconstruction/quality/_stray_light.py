"""Stray light that rises across the frame.

Uniform stray light does no harm. A rise within a subimage looks like a change of its size; the same rise in all
lenslets looks like a sample near the source. It is measured between the openings, where a wavefront moves little light.
"""

import math

import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import Booleans, Counts, Floats
from reconstruction.geometry import Sensor, lenslet_centers

_GAP = 0.1  # of the brightest; darker samples lie between the openings
_FEWEST_SAMPLES, _FEWEST_LENSLETS = 4, 9
_CERTAIN = 5.0  # standard errors of the rise
_PLANE = 3  # terms


class StrayLight:
    """Measures the rise of stray light from lenslet to lenslet, against one reference."""

    def __init__(
        self,
        sensor: Sensor,
        *,
        lit: Booleans,
        light: Floats,
        sampled: NDArray[np.intp],
        is_good: Booleans,
        dark: Floats | float,
    ) -> None:
        """Prepare the planes of the lenslets whose gaps are dark enough.

        Parameters
        ----------
        sensor : Sensor
        lit : (lenslet_row, lenslet_column)
        light, sampled, is_good : (lit lenslet, sample)
            Of the reference, counts above the dark; pixel of the flattened frame; whether it is good.
        dark : float or (lit lenslet, sample)
            Counts; any number if unknown.
        """
        self._brightest = float(np.max(light, initial=0.0))
        gaps = is_good & (light < _GAP * self._brightest)
        gaps[np.count_nonzero(gaps, axis=1) < _FEWEST_SAMPLES] = False
        self._pixels, self._expected = sampled[gaps], (light + dark)[gaps]
        lenslets, self._lenslet, self._samples = np.unique(np.nonzero(gaps)[0], return_inverse=True, return_counts=True)
        place = lenslet_centers(sensor.arrangement, *lit.shape)[lit][lenslets]  # pitches
        self._plane = np.column_stack([place, np.ones(len(place))])
        self._is_measured = len(place) >= _FEWEST_LENSLETS and np.linalg.matrix_rank(self._plane) == _PLANE
        self._inverse = np.linalg.pinv(self._plane) if self._is_measured else self._plane.T

    def rise(self, frame: Counts) -> float:
        """Rise per pitch of a frame (pixel,), counts, beyond chance, over the brightest; 0 if unknown.

        A plane is fitted by least squares to what the gaps of each lenslet have more than in the reference; the scatter
        about it gives the standard error, as in any linear regression.
        """
        if not self._is_measured:
            return 0.0
        added = np.bincount(self._lenslet, frame[self._pixels] - self._expected) / self._samples
        plane = self._inverse @ added
        scatter = float(np.sum((added - self._plane @ plane) ** 2)) / (len(added) - _PLANE)
        error = math.sqrt(scatter * float(np.max(np.sum(self._inverse[:2] ** 2, axis=1))))
        return max(math.hypot(*plane[:2]) - _CERTAIN * error, 0.0) / self._brightest
