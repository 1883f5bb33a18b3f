"""Clipped pixels: many of them at the highest count, few just below it."""

import numpy as np

from reconstruction.arrays import Counts

_PILED_UP = 3.0  # times as many pixels within one scatter of the highest count as within the next one
_BY_CHANCE = 10  # more pixels within that next scatter than seen, where few are
_EDGE, _MOST_EDGE = 6.0, 3.0  # read noises between the lowest and highest clipped pixel; at most so many scatters
_FINEST = 1e-3  # of the highest count, where the scatter is unknown


def clip_level(counts: Counts, scatter: float = 0.0, read_noise: float = 0.0) -> float | None:
    """Count above which pixels are clipped: they pile up at the highest count; None without a pile.

    A full well may lie below the camera's full scale, and read noise blurs its edge. Light without a limit has ever
    fewer pixels towards its highest count.

    Parameters
    ----------
    counts
        Any number of pixels.
    scatter : float
        Standard deviation of the brightest pixels if they were not clipped, counts; 0 if unknown.
    read_noise : float
        Standard deviation of what is added after clipping, counts. Beyond half the scatter, clipping is missed.
    """
    top = float(counts.max())
    edge = min(_EDGE * read_noise, _MOST_EDGE * scatter)
    step = max(scatter, edge, 1.0 if np.issubdtype(counts.dtype, np.integer) else 0.0, _FINEST * abs(top))
    piled = int(np.count_nonzero(counts > top - step))
    below = int(np.count_nonzero(counts > top - 2 * step)) - piled
    return top - step if is_piled_up(piled, below) else None


def is_piled_up(piled: int, below: int) -> bool:
    """Return whether so many pixels within one step of the highest count are clipped, by those within the next one."""
    return bool(piled > _PILED_UP * (below + _BY_CHANCE))


def clipped_fraction(counts: Counts, scatter: float = 0.0, read_noise: float = 0.0) -> float:
    """Share of the pixels above the `clip_level`."""
    level = clip_level(counts, scatter, read_noise)
    return 0.0 if level is None else np.count_nonzero(counts > level) / counts.size
