"""Registration by one shift per lenslet: the space-invariant method that the paper compares with.

The sum of squared differences of subimage and reference at all whole-pixel shifts within reach, and the minimum of a
quadratic through the 3 x 3 values about the least one (Löfdahl 2010, Astronomy & Astrophysics 524, A90).
"""

import numpy as np

from reconstruction.arrays import Booleans, Floats, Image
from reconstruction.displacement import Displacement, LensletStatus, diagonal_covariance
from reconstruction.errors import ReconstructionError
from reconstruction.geometry import Field
from reconstruction.modes.field_modes import LegendreModes
from reconstruction.registration.subimages import ReferenceSubimages, classify_lenslets, normalised

_MISFIT = 0.7  # residual over contrast above which the frame does not match, however deformed


class Correlation:
    """Registration by one shift of each subimage."""

    def __init__(self, reference: ReferenceSubimages, _field: Field) -> None:
        """Prepare for shifts that leave the field inside the lenslet's cell."""
        range_px = reference.reach_px - reference.half_width_px
        if range_px < 1:
            raise ReconstructionError("the field fills the lenslets' cells: no shift of it can be correlated")
        self._reference, self._modes = reference, LegendreModes(1)
        self._search = int(range_px) + 1  # the outermost shifts are only neighbours of a minimum
        self._light = normalised(reference.light.reshape(-1, reference.width, reference.width))

    def __call__(self, light: Image, *, saturated: Booleans, start: Displacement | None = None) -> Displacement:  # noqa: ARG002 - each frame is searched anew
        """Register a frame; see `displacement.RegistrationMethod`."""
        reference = self._reference
        window = reference.cut(light)
        mismatch, pixels = self._mismatch(normalised(window))
        shift, variance, least, found = _quadratic_minimum(mismatch)
        residual_rms = np.sqrt(least / pixels)
        variance *= least[:, None] / (pixels - 3)  # the residual is taken for noise

        return classify_lenslets(
            reference,
            self._modes,
            (shift - self._search)[..., None],
            covariance=diagonal_covariance(variance[:, None]),
            residual_rms=residual_rms * reference.contrast / reference.contrast.max(),
            contrast=window.std(axis=(1, 2)),
            faults={
                LensletStatus.DIVERGED: ~(found & (residual_rms < _MISFIT)),
                LensletStatus.SATURATED: reference.touched(saturated),
            },
        )

    def _mismatch(self, window: Floats) -> tuple[Floats, int]:
        """Sum of squared differences at all shifts, (L, shift_y, shift_x), and its number of pixels."""
        search, width = self._search, self._reference.width
        inner = width - 2 * search  # the middle of the reference, so that every shift of it lies in the window
        middle = self._light[:, search : search + inner, search : search + inner]
        shifts = 2 * search + 1
        mismatch = np.empty((len(window), shifts, shifts))
        for row, column in np.ndindex(shifts, shifts):
            difference = window[:, row : row + inner, column : column + inner] - middle
            mismatch[:, row, column] = np.einsum("lyx,lyx->l", difference, difference)
        return mismatch, inner**2


def _quadratic_minimum(mismatch: Floats) -> tuple[Floats, Floats, Floats, Booleans]:
    """Minimum of a quadratic about the least of the mismatches (L, shift_y, shift_x).

    Returns its position in samples (L, xy), the position's variance (L, xy) per variance of a pixel, the mismatch there
    (L,), and whether it lies inside the border, (L,).
    """
    lenslets, rows, columns = mismatch.shape
    least = mismatch.reshape(lenslets, -1).argmin(axis=1)
    row, column = np.divmod(least, columns)
    inside = (row > 0) & (row < rows - 1) & (column > 0) & (column < columns - 1)
    row, column = np.clip(row, 1, rows - 2), np.clip(column, 1, columns - 2)
    around = np.arange(-1, 2)
    s = mismatch[
        np.arange(lenslets)[:, None, None], row[:, None, None] + around[:, None], column[:, None, None] + around
    ]

    slope_x, slope_y = (s[:, 1, 2] - s[:, 1, 0]) / 2, (s[:, 2, 1] - s[:, 0, 1]) / 2
    bend_x = s[:, 1, 2] - 2 * s[:, 1, 1] + s[:, 1, 0]
    bend_y = s[:, 2, 1] - 2 * s[:, 1, 1] + s[:, 0, 1]
    twist = (s[:, 2, 2] - s[:, 2, 0] - s[:, 0, 2] + s[:, 0, 0]) / 4
    determinant = bend_x * bend_y - twist**2
    convex = (bend_x > 0) & (determinant > 0)
    determinant = np.where(convex, determinant, 1.0)
    step_x = (twist * slope_y - bend_y * slope_x) / determinant
    step_y = (twist * slope_x - bend_x * slope_y) / determinant
    found = inside & convex & (np.maximum(np.abs(step_x), np.abs(step_y)) <= 1)
    position = np.stack([column + step_x, row + step_y], axis=-1)
    variance = 2 * np.stack([bend_y, bend_x], axis=-1) / determinant[:, None]  # the bends are twice sum (dI0/dx)^2
    bottom = np.maximum(s[:, 1, 1] + (slope_x * step_x + slope_y * step_y) / 2, 0)
    return position, variance, bottom, found
