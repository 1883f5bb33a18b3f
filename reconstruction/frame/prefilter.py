"""The compiled prefilter of cubic B-splines: along columns by its recursion, along rows by its impulse response.

With z = sqrt(3) - 2 it is -6 z / ((1 - z/x) (1 - z x)), x the shift by a pixel (Unser 1999, IEEE Signal Processing
Magazine 16, 22). A recursion works on all columns of a row at once; along rows a plain convolution is quicker, with the
response (1 + z) / (1 - z) z^|k| cut where it has fallen to 1e-6.
"""

from __future__ import annotations

import numpy as np

from reconstruction.arrays import Image
from reconstruction.runtime.compilation import compiled

_POLE = np.sqrt(3.0) - 2.0
_REACH = 10
_RESPONSE = _POLE ** np.arange(_REACH + 1)
_Z = np.float32(_POLE)
# The recursion multiplies a constant by 1 / (1 - z)^2, which the response along rows takes back.
_TAPS = (_RESPONSE / (2 * _RESPONSE.sum() - 1) * (1 - _POLE) ** 2).astype(np.float32)
_RUN_IN = 14  # rows before and behind a strip, from which the recursion forgets how it began
STRIP = 64  # rows; that they are always the same makes the result independent of the number of threads


@compiled
def prefilter(image: Image, coefficients: Image, first: int, step: int) -> None:
    """Fill in every `step`-th strip of the coefficients (row, column), mirrored at the borders, from `first` on."""
    rows, columns = image.shape
    work = np.empty((STRIP + 2 * _RUN_IN, columns), np.float32)
    line = np.empty(columns + 2 * _REACH, np.float32)
    beyond = np.array([_mirrored(k, columns) for k in range(-_REACH, columns + _REACH) if not 0 <= k < columns])
    for top in range(first * STRIP, rows, step * STRIP):
        bottom = min(top + STRIP, rows)
        last = bottom - top + 2 * _RUN_IN - 1
        work[0] = image[_mirrored(top - _RUN_IN, rows)]
        for row in range(1, last + 1):
            _add(image[_mirrored(top - _RUN_IN + row, rows)], work[row - 1], work[row])
        for row in range(last - 1, _RUN_IN - 1, -1):
            _add_to(work[row + 1], work[row])
        for row in range(top, bottom):
            source = work[row - top + _RUN_IN]
            line[_REACH : _REACH + columns] = source
            for k in range(_REACH):
                line[k], line[_REACH + columns + k] = source[beyond[k]], source[beyond[_REACH + k]]
            _convolve(line, coefficients[row])


@compiled
def _add(row: Image, neighbour: Image, total: Image) -> None:
    for n in range(row.size):
        total[n] = row[n] + _Z * neighbour[n]


@compiled
def _add_to(neighbour: Image, row: Image) -> None:
    for n in range(row.size):
        row[n] += _Z * neighbour[n]


@compiled
def _convolve(line: Image, row: Image) -> None:
    """Convolve a line, which is longer by the response's reach on both sides, with the response."""
    for n in range(row.size):
        total = _TAPS[0] * line[n + _REACH]
        for k in range(1, _REACH + 1):
            total += _TAPS[k] * (line[n + _REACH - k] + line[n + _REACH + k])
        row[n] = total


@compiled
def _mirrored(index: int, count: int) -> int:
    """Reflect an index about the first and the last of `count`, as often as it takes."""
    if count == 1:
        return 0
    index = abs(index) % (2 * count - 2)
    return min(index, 2 * count - 2 - index)
