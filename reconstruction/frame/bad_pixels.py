"""Dead and hot camera pixels: detection, and replacement by their neighbours."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from reconstruction.arrays import Floats, Image, Mask

# Diffraction smooths images: the neighbours of a star's brightest pixel have about 0.6 of its light.
_DEAD = 0.3  # a dead pixel has less than this fraction of its faintest neighbour ...
_LIT = 0.2  # ... which has more than this fraction of the frame's peak
_HOT = 3.0  # a hot pixel exceeds its brightest neighbour by this factor ...
_BRIGHT = 2.0  # ... and the frame's peak by this one; single electrons at a large gain do not
_SIGNIFICANT = 8.0  # standard deviations of the difference between a pixel and its neighbours' mean
_HOT_IN_DARK = 0.05  # excess in the dark over the frame's peak; less is harmless
_OUTSTANDING = 4.0  # excess in the dark over its brightest ordinary pixels, which are single electrons
_PEAK_PERCENT = 99.9  # percentile taken for the peak, so that a hot pixel does not count
_BACKGROUND_PERCENT = 1.0

_NEIGHBOURS = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], np.bool_)
_FURTHER = np.pad(np.zeros((3, 3), np.bool_), 1, constant_values=True)  # the 16 pixels around the neighbours


def find_bad_pixels(reference: NDArray[np.generic], dark: NDArray[np.generic] | None = None) -> Mask:
    """Find dead and hot pixels in a reference and optionally its dark (row, column), counts: bool (row, column).

    Conservative: a pixel is bad only if neither a diffraction-limited image nor noise can explain it.
    """
    light = np.asarray(reference, np.float64) - (0 if dark is None else np.asarray(dark, np.float64))
    background, peak = np.percentile(light, (_BACKGROUND_PERCENT, _PEAK_PERCENT))
    light, peak = light - background, peak - background
    if not peak > 0:
        return np.zeros(light.shape, np.bool_)
    faintest = ndimage.minimum_filter(light, footprint=_NEIGHBOURS, mode="mirror")
    brightest = ndimage.maximum_filter(light, footprint=_NEIGHBOURS, mode="mirror")
    bad = (light < _DEAD * faintest) & (faintest > _LIT * peak)
    bad |= (light > _HOT * np.maximum(brightest, 0)) & (light > _BRIGHT * peak)
    bad &= _stands_out(light)
    if dark is not None:
        excess = np.asarray(dark, np.float64)
        excess = excess - ndimage.median_filter(excess, 5, mode="mirror")
        usual = _OUTSTANDING * np.percentile(excess, _PEAK_PERCENT)
        bad |= (excess > max(_HOT_IN_DARK * peak, usual)) & _stands_out(excess)
    return np.asarray(bad)


def _stands_out(image: Floats) -> Mask:
    """True for pixels that differ from their neighbours' mean far more than the pixels around them do."""
    cross = np.array([[0, 1, 0], [1, 0, 1], [0, 1, 0]]) / 4
    difference = image - ndimage.correlate(image, cross, mode="mirror")
    usual = ndimage.correlate(difference**2, _FURTHER / np.count_nonzero(_FURTHER), mode="mirror")
    return np.asarray(np.abs(difference) > _SIGNIFICANT * np.sqrt(np.maximum(usual, 0)))


def repaired(light: NDArray[Any], bad: Mask) -> Image:
    """Copy of an image (row, column), its bad pixels replaced by good neighbours; a spline would spread them."""
    row, column = np.nonzero(bad)
    if not row.size:
        return light
    light, missing = light.copy(), bad.copy()
    down, right = np.nonzero(np.ones((3, 3)))
    while row.size:
        around = (
            np.clip(row[:, None] + down - 1, 0, light.shape[0] - 1),
            np.clip(column[:, None] + right - 1, 0, light.shape[1] - 1),
        )
        known = ~missing[around]
        count = known.sum(axis=1)
        found = count > 0
        if not found.any():
            light[row, column] = 0
            break
        mean = np.sum(light[around] * known, axis=1)[found] / count[found]
        light[row[found], column[found]], missing[row[found], column[found]] = mean, False
        row, column = row[~found], column[~found]
    return light
