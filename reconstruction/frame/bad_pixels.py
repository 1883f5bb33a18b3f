"""Pixels of the camera that show no light, or always too much: finding them, and looking past them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from reconstruction.arrays import Floats, Image, Mask

# Diffraction makes images smooth: the neighbours of the brightest pixel of a star show 0.6 of it, or less by noise.
_DEAD = 0.3  # of the faintest neighbour; a pixel below it may be dead
_HOT = 3.0  # of the brightest neighbour; a pixel above it may be hot
_LIT = 0.2  # of the frame's brightest light; a dead pixel shows only among neighbours above it
_BRIGHT = 2.0  # likewise, of a hot pixel; single electrons behind a large gain stand out of the darkness by less
_SIGNIFICANT = 8.0  # standard deviations of how neighbouring pixels differ from the mean of theirs
_HOT_IN_DARK = 0.05  # of the frame's brightest light; less does no harm
_OUTSTANDING = 4.0  # times what the dark's own brightest pixels, of single electrons, show
_PEAK_PERCENT = 99.9  # of the pixels, below which the brightest of an image is; so no hot pixel is taken for it
_BACKGROUND_PERCENT = 1.0

_NEIGHBOURS = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], np.bool_)
_FURTHER = np.pad(np.zeros((3, 3), np.bool_), 1, constant_values=True)  # the ring about the neighbours


def find_bad_pixels(reference: NDArray[np.generic], dark: NDArray[np.generic] | None = None) -> Mask:
    """Find dead and hot pixels (row, column) in the frame without the sample and, if there is one, the dark; counts.

    It is cautious: a pixel is bad when no image that the lenslets can make, and no noise, would look like that.
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
    """Which pixels (row, column) differ from the mean of their neighbours by far more than those further away do."""
    cross = np.array([[0, 1, 0], [1, 0, 1], [0, 1, 0]]) / 4
    difference = image - ndimage.correlate(image, cross, mode="mirror")
    usual = ndimage.correlate(difference**2, _FURTHER / np.count_nonzero(_FURTHER), mode="mirror")
    return np.asarray(np.abs(difference) > _SIGNIFICANT * np.sqrt(np.maximum(usual, 0)))


def repaired(light: NDArray[Any], bad: Mask) -> Image:
    """Give each bad pixel of an image (row, column) the mean of the good ones about it; the image is not changed.

    So the spline, which carries a pixel's value far, has nothing to carry.
    """
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
