"""Clipped pixels: many of them at the highest count, few just below it."""

import numpy as np

from reconstruction.arrays import Counts

_PILED_UP = 3.0  # times as many pixels within one scatter of the highest count as within the next one
_BY_CHANCE = 10  # more pixels within that next scatter than seen, where few are
_FINEST = 1e-3  # of the highest count, where the scatter is unknown


def clipped_fraction(counts: Counts, scatter: float = 0.0) -> float:
    """Share of pixels piled up at the highest count; 0 without a pile.

    A full well may lie below the camera's full scale, and read noise blurs its edge. Light without a limit has ever
    fewer pixels towards its highest count.

    Parameters
    ----------
    counts
        Any number of pixels.
    scatter : float
        Standard deviation of the brightest pixels if they were not clipped, counts; 0 if unknown.
    """
    top = float(counts.max())
    step = max(scatter, 1.0 if np.issubdtype(counts.dtype, np.integer) else 0.0, _FINEST * abs(top))
    piled = np.count_nonzero(counts > top - step)
    below = np.count_nonzero(counts > top - 2 * step) - piled
    return piled / counts.size if piled > _PILED_UP * (below + _BY_CHANCE) else 0.0
