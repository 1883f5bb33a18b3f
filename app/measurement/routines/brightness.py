"""How bright a frame is where it is brightest, whatever the camera's bad pixels show."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

_USUAL_PERCENT = 90.0  # of the cells; so many may be spoilt by a hot pixel on an image or a cosmic ray
_TOP_PERCENT = 98.0  # likewise, where so few are lit that the one above is dark
_MOST_UNEVEN = 3.0  # times; the one above is dark if the top exceeds it by more
_OUTSTANDING = 1.3  # times nine in ten of the cells: more than a beam as wide as the array makes of its middle
_HOT = 3.0  # times what its neighbours differ by, above all of them: neither a star's peak nor noise stands out so far
_FROM_1_TO_10 = 1.0448  # standard deviations between these percentiles of a normal distribution; so many
_FROM_10_TO_50 = 1.2816  # pixels lie between the subimages, whatever the source
_SIGMA_OF_MEDIAN = 1.4826  # standard deviation over median of the absolute value, of a normal distribution
_LEAST_NOISE = 0.3  # counts: that of rounding
_HIDDEN_NOISE = 1.0  # counts; so much may hide in a frame whose dark pixels are all 0, the end of the scale
_NEIGHBOURS = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], np.bool_)


@dataclass(frozen=True, slots=True)
class Brightness:
    """Of one frame, in counts."""

    level: float  # the brightest pixel of the brightest lenslets, background included: what saturates
    background: float
    noise: float  # of a dark pixel, standard deviation


def brightness(pixels: NDArray[np.integer[Any]], cell_px: float) -> Brightness:
    """Measure a frame (row, column), counts, that shows about one lenslet in each square of `cell_px` pixels.

    Each cell has its brightest pixel, single hot ones left out; the level is that of the brightest cell but for those
    that stand out of all others.
    """
    light = pixels.astype(np.float32)
    darkest, dark, middle = (float(value) for value in np.percentile(light, (1, 10, 50)))
    of_steps = _SIGMA_OF_MEDIAN * float(np.median(np.abs(np.diff(light, axis=1)))) / np.sqrt(2)
    noise = max(min(of_steps, (dark - darkest) / _FROM_1_TO_10), _LEAST_NOISE)  # either may see images, too
    if darkest <= 0:  # the scale has cut off half of the noise
        noise = max(of_steps, _HIDDEN_NOISE)
    background = min(dark + _FROM_10_TO_50 * noise, middle)
    brightest = ndimage.maximum_filter(light, footprint=_NEIGHBOURS, mode="mirror")
    faintest = ndimage.minimum_filter(light, footprint=_NEIGHBOURS, mode="mirror")
    is_hot = light - brightest > _HOT * np.maximum(brightest - faintest, noise)
    cells = np.where(is_hot, brightest, light)
    for axis, length in enumerate(light.shape):
        cells = np.maximum.reduceat(cells, _edges(length, cell_px), axis=axis)
    above = cells - background
    usual, top = np.percentile(above, (_USUAL_PERCENT, _TOP_PERCENT), method="lower")
    usual = max(usual if usual > top / _MOST_UNEVEN else top, 0.0)
    return Brightness(background + float(np.max(above[above <= _OUTSTANDING * usual])), background, noise)


def _edges(length: int, cell_px: float) -> NDArray[np.intp]:
    """Where the cells begin along an axis."""
    cells = max(1, int(length / cell_px))
    return (np.arange(cells) * (length / cells)).astype(np.intp)
