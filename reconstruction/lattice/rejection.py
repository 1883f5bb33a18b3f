"""Whether what was fitted is a lattice at all, and if not, why."""

from __future__ import annotations

import math

import numpy as np

from reconstruction.arrays import Floats, Image
from reconstruction.lattice.cells import Cells
from reconstruction.lattice.fit import Fit
from reconstruction.lattice.spectrum import Peak

_CONTRAST = 5e-3  # of the typical cell over the frame's range of light; a smooth frame has none but rounding
_RANGE_PERCENT = (0.5, 99.5)  # of the pixels lie in it
_OUTSTANDING = 4.0  # of a peak of the spectrum, over what is usual
_ONE_SIDED = 8.0  # of one of the two peaks over the other
_AGREEMENT = 0.5  # of the cells' harmonics, 1 when all point the same way; noise gives about 1 / sqrt(cells)
_ALIKE = 0.5  # correlation of the mean cells of two halves of the frame; noise gives about 0
_REPEATED = 0.98  # of the power of the typical cell; where it repeats itself all is in every second harmonic, say
_SCATTER = 0.1  # RMS distance of the cells' light from the lattice, in pitches
_FEWEST = 3  # lit lenslets


def why_no_lattice(fit: Fit | None, peak: Peak, light: Image, brightest: int) -> str:
    """Say why what was fitted to the light of a frame (row, column) is no lattice; empty when it is one.

    At least `brightest` lenslets must be lit.
    """
    is_lit = np.zeros(1, np.bool_) if fit is None else fit.match.is_lit
    lit = int(np.count_nonzero(is_lit))
    if fit is None or fit.agreement.min() < _AGREEMENT or _halves_alike(fit.cells) < _ALIKE:
        return _why_irregular(peak, lit)
    if not fit.match.typical.std() > _CONTRAST * float(np.ptp(np.percentile(light, _RANGE_PERCENT))):
        return "was the light on?"
    if lit < max(brightest, _FEWEST) or np.any(np.ptp(fit.cells.index[is_lit], axis=0) < 1):
        return f"light in {lit} of its lenslets is too little"
    if (scatter := float(np.sqrt(np.mean(np.sum(fit.off_lattice[is_lit] ** 2, axis=-1))))) > _SCATTER:
        return f"the images lie {100 * scatter:.0f} % of the pitch beside a square lattice"
    if _repeats_inside(fit.match.typical):
        return "its cells hold the same image more than once; check sensor.lenslet_pitch_m and pixel_pitch_m"
    return ""


def is_outstanding(peak: Peak) -> bool:
    """Whether the spectrum shows more than noise does."""
    return max(peak.strength) >= _OUTSTANDING


def _why_irregular(peak: Peak, lit: int) -> str:
    """Say what a frame may show whose cells are not alike, `lit` of which seem lit."""
    if not is_outstanding(peak):
        return "was the light on?"
    if peak.hexagonal_strength > max(_OUTSTANDING, math.sqrt(math.prod(peak.strength))):
        return "it seems to show a hexagonal one, and only square ones are supported"
    if max(peak.strength) > _ONE_SIDED * min(peak.strength):
        return "its light repeats in one direction only"
    return "was the light on?" if lit < _FEWEST else "its cells do not hold the same image"


def _halves_alike(cells: Cells) -> float:
    """Correlation of the mean cells of every other column, every other row and every other cell: the least of them."""
    x, y = cells.index.T
    light = cells.light - cells.light.mean(axis=(1, 2), keepdims=True)
    least = 1.0
    for half in (x % 2 == 0, y % 2 == 0, (x + y) % 2 == 0):
        if half.any() and not half.all():
            one, other = light[half].mean(axis=0), light[~half].mean(axis=0)
            least = min(least, _correlation(one, other))
    return least


def _repeats_inside(typical: Floats) -> bool:
    """Whether the typical cell (S, S) holds the same image two, three or five times along x or y."""
    power = np.abs(np.fft.fft2(typical)) ** 2
    order = np.abs(np.fft.fftfreq(len(typical), 1 / len(typical)))
    lines = power.sum(axis=0), power.sum(axis=1)
    return any(line[order % times == 0].sum() > _REPEATED * line.sum() for line in lines for times in (2, 3, 5))


def _correlation(one: Floats, other: Floats) -> float:
    return float(np.corrcoef(one.ravel(), other.ravel())[0, 1])
