"""Sum over object points of the images behind every lenslet, on the grid that defines them exactly.

"Folded" images are four sums, from which the four mirror-symmetric positions (+-y, +-x) follow at the end.
"""

import math
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import Floats
from simulated_devices.optics.compiled import compiled

Images: TypeAlias = NDArray[np.float32]


class ImageSum:
    """Accumulates |Fourier transform|^2 of every lenslet's field, object point by object point; used by one thread.

    The four sums are (4, y, lenslet_row, lenslet_column, x) with y and x the positive half of the 2n positions.
    """

    def __init__(self, aperture: Floats, lenslet_rows: int, lenslet_columns: int) -> None:
        """Prepare for lenslets with this amplitude (sample_row, sample_column), the same about both axes."""
        n, half = len(aperture), len(aperture) // 2
        self._half, self._rows, self._columns = half, lenslet_rows, lenslet_columns
        # k u.y / f = 2 pi u' y' / (2n), u' in pupil samples, y' in steps of the 2n-point grid
        angle = 2 * np.pi / (2 * n) * np.outer(np.arange(half) + 0.5, np.arange(n) + 0.5)
        self._along_x = np.cos(angle).astype(np.float32), np.sin(angle).astype(np.float32)  # each (u, x)
        self._along_y = tuple(np.ascontiguousarray(matrix.T) for matrix in self._along_x)  # each (y, u)
        quarter = aperture[half:, half:].astype(np.float32)
        self._amplitude = None  # 1 everywhere
        if not np.all(quarter == 1):
            self._amplitude = np.tile(np.repeat(quarter, lenslet_rows, axis=0), (1, 2 * lenslet_columns))
        lenslets = lenslet_rows * lenslet_columns
        self.folded: Images = np.zeros((4, n * lenslets * n), np.float32)
        # Work space: allocating it for every point would cost more than the arithmetic.
        width = lenslet_columns * half
        self._field = np.empty((2, 2, half * lenslet_rows, 2 * width), np.float32)  # (re|im, y half, row, column)
        self._parity_y = np.empty_like(self._field[:, 0])
        self._parity = np.empty((2, half * lenslets, half), np.float32)
        self._half_way = np.empty((2, 2, 2, half * lenslets, n), np.float32)  # (y parity, re|im, x parity, ...)
        self._transform = np.empty((2, 2, 2, n, lenslets * n), np.float32)

    def add(self, field: NDArray[np.complex64], weight: float) -> None:
        """Add one object point's image, `weight` times; `field` (row, column) in the order of `ForwardModel`."""
        halves = field.reshape(self._field.shape[1:])
        self._field[0], self._field[1] = halves.real, halves.imag
        if self._amplitude is not None:
            self._field *= self._amplitude
        width = self._field.shape[-1] // 2
        for odd_y, combine_y in enumerate((np.add, np.subtract)):
            combine_y(self._field[:, 1], self._field[:, 0], out=self._parity_y)
            for odd_x, combine_x in enumerate((np.add, np.subtract)):
                parity = self._parity.reshape(2, -1, width)
                combine_x(self._parity_y[..., width:], self._parity_y[..., :width], out=parity)
                for part in range(2):
                    half_way = self._half_way[odd_y, part, odd_x]
                    np.matmul(self._parity[part], self._along_x[odd_x], out=half_way)
                    across = half_way.reshape(self._half, -1)
                    np.matmul(self._along_y[odd_y], across, out=self._transform[odd_y, part, odd_x])
        _add_squares(self._transform.reshape(2, 2, 2, -1), np.float32(weight), self.folded)


@compiled
def _add_squares(transform: Images, weight: np.float32, folded: Images) -> None:
    """Add weight * |F|^2 at the four positions (+-y, +-x), as four sums, from the parts a, b, c, d of even/odd y and x.

    F(s_y y, s_x x) = a - i s_x b - i s_y c - s_y s_x d, so |F|^2 = sum of squares + s_y s_x 2 (-Re a d* + Re b c*)
    + s_x 2 Im(a* b ...) + s_y 2 Im(a* c ...), with the signs written out below.
    """
    for k in range(transform.shape[3]):
        ar, ai, br, bi = transform[0, 0, 0, k], transform[0, 1, 0, k], transform[0, 0, 1, k], transform[0, 1, 1, k]
        cr, ci, dr, di = transform[1, 0, 0, k], transform[1, 1, 0, k], transform[1, 0, 1, k], transform[1, 1, 1, k]
        squares = ar * ar + ai * ai + br * br + bi * bi + cr * cr + ci * ci + dr * dr + di * di
        folded[0, k] += weight * squares
        folded[1, k] += weight * (br * cr + bi * ci - ar * dr - ai * di)
        folded[2, k] += weight * (ar * bi - ai * br + cr * di - ci * dr)
        folded[3, k] += weight * (ar * ci - ai * cr + br * di - bi * dr)


def unfold(folded: Images, lenslet_rows: int, lenslet_columns: int) -> Images:
    """Turn the four sums into images on the whole grid: (lenslet_row, lenslet_column, y, x), each side 2n positions."""
    n = math.isqrt(folded.shape[1] // (lenslet_rows * lenslet_columns))
    squares, both, only_x, only_y = folded.reshape(4, n, lenslet_rows, lenslet_columns, n).transpose(0, 2, 3, 1, 4)
    images = np.empty((lenslet_rows, lenslet_columns, 2 * n, 2 * n), np.float32)
    for sign_y, along_y in ((-1, slice(n - 1, None, -1)), (1, slice(n, None))):
        for sign_x, along_x in ((-1, slice(n - 1, None, -1)), (1, slice(n, None))):
            images[:, :, along_y, along_x] = squares + 2 * (sign_y * sign_x * both + sign_x * only_x + sign_y * only_y)
    return images
