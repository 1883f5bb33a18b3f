"""Dead and hot pixels of the sensor: found in a reference and its dark, and repaired."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from reconstruction.arrays import SIGMA_OF_MEDIAN, Booleans, Floats, Image
from reconstruction.frame.noise import beyond_optics
from reconstruction.frame.pixels import BACKGROUND_PERCENT, PEAK_PERCENT
from reconstruction.runtime.opencv import cv2

# Diffraction smooths images: the neighbours of a star's brightest pixel have about 0.6 of its light.
_DEAD = 0.3  # a dead pixel has less than this fraction of its faintest neighbour ...
_LIT = 0.2  # ... which has more than this fraction of the frame's peak
_HOT = 3.0  # a hot pixel exceeds its brightest neighbour by this factor ...
_BRIGHT = 2.0  # ... and the frame's peak by this one; single electrons at a large gain do not
_SIGNIFICANT = 8.0  # standard deviations of the difference between a pixel and its neighbours' mean
_HOT_IN_DARK = 0.05  # excess in the dark over the frame's peak; less is harmless
_OUTSTANDING = 4.0  # excess in the dark over its brightest ordinary pixels, which are single electrons

_NEIGHBOURS = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], np.uint8)
_FURTHER = np.pad(np.zeros((3, 3), np.bool_), 1, constant_values=True)  # the 16 pixels around the neighbours


def find_bad_pixels(
    reference: NDArray[np.generic], dark: NDArray[np.generic] | None = None, *, blur_px: float
) -> Booleans:
    """Find dead and hot pixels in a reference, and its dark, (row, column), counts: bool (row, column).

    What stays on the sensor would match at no displacement. Conservative: a pixel is bad only if neither a
    diffraction-limited image of this blur nor noise can explain it.
    """
    light = np.asarray(reference, np.float64) - (0 if dark is None else np.asarray(dark, np.float64))
    background, peak = np.percentile(light, (BACKGROUND_PERCENT, PEAK_PERCENT))
    light, peak = light - background, peak - background
    if not peak > 0:
        return np.zeros(light.shape, np.bool_)
    mirrored = cv2.BORDER_REFLECT_101
    faintest, brightest = (each(light, _NEIGHBOURS, borderType=mirrored) for each in (cv2.erode, cv2.dilate))
    bad = (light < _DEAD * faintest) & (faintest > _LIT * peak)
    bad |= (light > _HOT * np.maximum(brightest, 0)) & (light > _BRIGHT * peak)
    bad &= _stands_out(light, bad)
    if dark is not None:
        around = np.pad(np.asarray(dark, np.float32), 2, mode="reflect")
        excess = np.asarray(dark, np.float64) - cv2.medianBlur(around, 5)[2:-2, 2:-2]
        hot = excess > max(_HOT_IN_DARK * peak, _OUTSTANDING * np.percentile(excess, PEAK_PERCENT))
        bad |= hot & _stands_out(excess, hot)
    return _with_outliers(light.astype(np.float32), np.asarray(bad), blur_px)


_OUTLIER = 0.08  # least deviation of an outlier over the peak ...
_ALONE = 2.5  # ... and over the RMS of those around it
_PASSES, _STEP = 12, np.float32(1.5)  # below 2 each step converges


def _with_outliers(light: Image, bad: Booleans, blur_px: float) -> Booleans:
    """Add the pixels that deviate from any image that optics can show, (row, column), the strongest ones first.

    A pixel's deviation also shows in its neighbours. So it is taken away before the others are looked at again, as in
    CLEAN (J. A. Hogbom, Astron. Astrophys. Suppl. 15, 417, 1974).
    """
    smooth = cv2.medianBlur(light, 3)
    dark, peak = np.percentile(smooth, (BACKGROUND_PERCENT, PEAK_PERCENT))
    bright = smooth > (dark + peak) / 2
    light = np.where(bad, smooth, light)
    for _ in range(_PASSES):
        if (found := beyond_optics(light, blur_px)) is None:
            break
        deviation = found[0] / np.float32(found[1])
        size = np.abs(deviation)
        least = max(_OUTLIER * (peak - dark), _SIGNIFICANT * SIGMA_OF_MEDIAN * np.median(size[bright]))
        around = np.sqrt(ndimage.correlate(size**2, _FURTHER / np.float32(np.count_nonzero(_FURTHER)), mode="constant"))
        size[bad] = 0
        new = (size > least) & (size > _ALONE * around) & (size == cv2.dilate(size, np.ones((3, 3), np.uint8)))
        if not new.any():
            break
        light = light - np.where(new, deviation, _STEP * found[0] * bad)
        bad = bad | new
    return bad


def _stands_out(image: Floats, some: Booleans) -> Booleans:
    """True for those of `some` pixels that differ from their neighbours' mean far more than those around."""
    if not some.any():
        return some
    cross = np.array([[0, 1, 0], [1, 0, 1], [0, 1, 0]]) / 4
    difference = image - ndimage.correlate(image, cross, mode="mirror")
    usual = ndimage.correlate(difference**2, _FURTHER / np.count_nonzero(_FURTHER), mode="mirror")
    return np.asarray(np.abs(difference) > _SIGNIFICANT * np.sqrt(np.maximum(usual, 0)))


def repaired(light: NDArray[Any], bad: Booleans) -> Image:
    """Image (row, column) with bad pixels replaced by neighbours, which a spline would spread; itself without any."""
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
