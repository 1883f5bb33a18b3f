"""Brightness of a frame's brightest lenslets, robust against bad pixels."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

_USUAL_PERCENT = 90.0  # percentile of the cells; the rest may contain hot pixels or cosmic rays
_TOP_PERCENT = 98.0  # percentile of the cells if so few are lit that the usual one is dark
_MOST_UNEVEN = 3.0  # ratio of top to usual cell above which the usual one is dark
_OUTSTANDING = 1.3  # times the usual cell; the middle of a beam as wide as the array stays below
_HOT = 3.0  # times the spread of its neighbours above all of them; neither a star's peak nor noise reaches it
_FROM_1_TO_10 = 1.0448  # standard deviations between the 1st and 10th percentile of a normal distribution
_FROM_10_TO_50 = 1.2816  # standard deviations; at least 10 % of the pixels lie between the subimages
_SIGMA_OF_MEDIAN = 1.4826  # standard deviation over median of the absolute value, of a normal distribution
_LEAST_NOISE = 0.3  # counts; rounding
_HIDDEN_NOISE = 1.0  # counts; noise that a frame whose dark pixels are clipped to 0 may hide
_NEIGHBOURS = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], np.bool_)


@dataclass(frozen=True, slots=True)
class Brightness:
    """Brightness of one frame, in counts."""

    level: float  # brightest pixel of the brightest lenslets, with background: what saturates
    background: float
    noise: float  # of a dark pixel, standard deviation


def brightness(pixels: NDArray[np.integer[Any]], cell_px: float) -> Brightness:
    """Measure a frame (row, column), counts, with about one lenslet per square of `cell_px` pixels.

    Each cell contributes its brightest pixel, single hot ones excluded; outlying cells are excluded from the level.
    """
    light = pixels.astype(np.float32)
    darkest, dark, middle = (float(value) for value in np.percentile(light, (1, 10, 50)))
    of_steps = _SIGMA_OF_MEDIAN * float(np.median(np.abs(np.diff(light, axis=1)))) / np.sqrt(2)
    noise = max(min(of_steps, (dark - darkest) / _FROM_1_TO_10), _LEAST_NOISE)  # both may include subimages
    if darkest <= 0:  # half of the noise is clipped
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
    """First pixel of every cell along an axis."""
    cells = max(1, int(length / cell_px))
    return (np.arange(cells) * (length / cells)).astype(np.intp)
