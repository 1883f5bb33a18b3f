"""Bicubic spline through a complex field on a regular grid about the optical axis.

Arrays are [row, column], row = y. Products with sparse bases evaluate the spline on grids of x and y.
"""

from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage, sparse
from scipy.interpolate import BSpline

from reconstruction.arrays import Floats

_CUBIC: Final = 3
EDGE = 8
"""Samples around the used part of a field; beyond them a spline does not feel that its edge is mirrored."""


class FieldSpline:
    """Field between its samples (row, column), complex; positions must lie within the edge, better by `EDGE`."""

    def __init__(self, samples: NDArray[np.complex128], sample_spacing_m: float) -> None:
        self._shape, self._spacing_m = samples.shape, sample_spacing_m
        self._coefficients = ndimage.spline_filter(samples, _CUBIC, np.complex128, mode="mirror")
        # Real and imaginary parts interleaved along y: (coefficient column, 2 x coefficient row).
        self._by_column = np.ascontiguousarray(self._coefficients.T.astype(np.complex64)).view(np.float32)

    def at(self, x_m: ArrayLike, y_m: ArrayLike) -> NDArray[np.complex128]:
        """Field at positions in m, element by element; x and y broadcast against each other."""
        x, y = np.broadcast_arrays(self._index(np.asarray(x_m), 1), self._index(np.asarray(y_m), 0))
        return np.asarray(
            ndimage.map_coordinates(self._coefficients, np.stack([y, x]), order=_CUBIC, prefilter=False, mode="mirror")
        )

    def column(self, x_m: Floats) -> Callable[[Floats], NDArray[np.complex64]]:
        """Contract the spline at the positions x (m); return the field (y, x) as a function of the positions y (m)."""
        product = self._basis(x_m, 1) @ self._by_column
        by_row = product.reshape(len(x_m), -1, 2).transpose(1, 0, 2)
        contracted = np.ascontiguousarray(by_row).reshape(self._shape[0], -1)  # (row, 2 x)
        return lambda y_m: np.asarray(self._basis(y_m, 0) @ contracted).view(np.complex64)

    def _index(self, position_m: Floats, axis: int) -> Floats:
        """Position in samples from the first one."""
        return np.asarray(position_m / self._spacing_m + (self._shape[axis] - 1) / 2, np.float64)

    def _basis(self, position_m: Floats, axis: int) -> sparse.csr_array[np.float32]:
        """Values of the spline's basis: sparse (position, coefficient), four entries a row."""
        knots = np.arange(self._shape[axis] + _CUBIC + 1) - 2.0
        return BSpline.design_matrix(self._index(position_m, axis), knots, _CUBIC).astype(np.float32)
