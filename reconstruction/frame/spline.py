"""Cubic B-spline interpolation of camera frames (Unser 1999, IEEE Signal Processing Magazine 16, 22).

Bilinear sampling and Keys' cubic convolution distort the wavefront by up to 0.2 rad; the interpolating B-spline does
not. With z = sqrt(3) - 2 and x the shift by a pixel, its prefilter is -6 z / ((1 - z/x) (1 - z x)): recursive along
columns, all columns of a row at once. Along rows, 1 / (1 - z x) = (1 + z x) (1 + z^2 x^2) (1 + z^4 x^4) ..., so that a
few convolutions with three numbers, at growing distances, do the same.

Interpolation at the fraction f of a pixel multiplies the wave exp(2 pi i nu x) by
sum_j B(j - f) exp(2 pi i nu (j - f)) / sum_j B(j) exp(2 pi i nu j), B the cubic B-spline. Its mean over all fractions,
sinc(nu)^4 / ((2 + cos(2 pi nu)) / 3), blurs a displaced image.
"""

from collections.abc import Callable
from functools import cache, lru_cache
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import toeplitz

from reconstruction.arrays import Floats, Image
from reconstruction.runtime.compilation import compiled, inlined
from reconstruction.runtime.counters import Counters, finish, is_finished, new_counters, take
from reconstruction.runtime.threads import in_threads

_POLE = np.sqrt(3.0) - 2.0
_Z = np.float32(_POLE)
_DISTANCES = (1, 2, 4, 8)  # px, between the three numbers of each convolution; what is left out is below 1e-8
_REACH = sum(_DISTANCES)
# The middle one and the other two. The recursion multiplies a constant by 1 / (1 - z)^2; the convolutions divide by it.
_TAPS = np.array([[1 + _POLE ** (2 * k), _POLE**k] for k in _DISTANCES])
_TAPS /= np.sum(_TAPS, axis=1, keepdims=True) + _TAPS[:, 1:]
_TAPS = (_TAPS * np.array([[(1 - _POLE) ** 2], [1], [1], [1]])).astype(np.float32)
_RUN_IN = 14  # extra rows on both sides of a strip, after which the recursion has forgotten its start
_AT_ONCE = 300_000  # positions that one thread interpolates at a time
_STRIP = 64  # rows; fixed, so that the result does not depend on the number of threads


def spline_coefficients(image: NDArray[np.uint16] | Image) -> Image:
    """B-spline coefficients of an image (row, column), mirrored at its borders."""
    coefficients, share = shared_coefficients(image)
    share()
    return coefficients


def shared_coefficients(image: NDArray[np.uint16] | Image) -> tuple[Image, Callable[[], None]]:
    """Coefficients of an image (row, column), and the work for threads to share: all there when one call returns."""
    light = np.require(image, np.float32, ("C", "W"))  # so that Numba compiles one signature only
    coefficients, counters = np.empty(light.shape, np.float32), new_counters()
    rows, columns = light.shape
    beyond = _beyond(columns)

    def share() -> None:
        work = np.empty((_STRIP + 2 * _RUN_IN, columns), np.float32)
        lines = np.empty((2, columns + 2 * _REACH), np.float32)
        _prefilter(light, coefficients, counters, work, lines, beyond)
        if not is_finished(counters, -(-rows // _STRIP)):  # another thread was interrupted amid a strip
            _prefilter(light, coefficients, new_counters(), work, lines, beyond)

    return coefficients, share


@lru_cache(maxsize=16)
def _beyond(columns: int) -> NDArray[np.intp]:
    """Columns that a row of so many columns has, mirrored, before its first one and after its last one."""
    return np.array([_mirrored_index(k, columns) for k in range(-_REACH, columns + _REACH) if not 0 <= k < columns])


def interpolate(coefficients: Image, position_px: Floats) -> tuple[Floats, Floats]:
    """Interpolate at positions (..., xy) in the image: values (...) and gradients (..., xy) per pixel."""
    values, gradients = np.empty(position_px.shape[:-1]), np.empty(position_px.shape)
    image = np.require(coefficients, np.float32, ("C", "W"))  # so that Numba compiles one signature only
    position = np.require(position_px, np.float64, ("C", "W")).reshape(-1, 2)
    flat_values, flat_gradients = values.reshape(-1), gradients.reshape(-1, 2)

    def share(first: int) -> None:
        some = slice(first, first + _AT_ONCE)
        _interpolate(image, position[some], flat_values[some], flat_gradients[some])

    in_threads(share, range(0, len(position), _AT_ONCE))
    return values, gradients


@compiled
def _interpolate(coefficients: Image, position_px: Floats, values: Floats, gradients: Floats) -> None:
    rows, columns = coefficients.shape
    for n in range(values.size):
        left, above = np.floor(position_px[n, 0]), np.floor(position_px[n, 1])
        along, along_slopes = _weights(position_px[n, 0] - left)
        across, across_slopes = _weights(position_px[n, 1] - above)
        value, slope_x, slope_y = 0.0, 0.0, 0.0
        top, first = int(above) - 1, int(left) - 1
        is_inside = 0 <= top < rows - 3 and 0 <= first < columns - 3
        for i in range(4):
            row = coefficients[top + i if is_inside else _mirrored_index(top + i, rows)]
            of_row, slope_of_row = 0.0, 0.0
            for j in range(4):
                tap = row[first + j if is_inside else _mirrored_index(first + j, columns)]
                of_row += along[j] * tap
                slope_of_row += along_slopes[j] * tap
            value += across[i] * of_row
            slope_x += across[i] * slope_of_row
            slope_y += across_slopes[i] * of_row
        values[n], gradients[n, 0], gradients[n, 1] = value, slope_x, slope_y


def interpolate_evenly(coefficients: Image, start_px: Floats, steps_px: Floats, shape: tuple[int, int]) -> Image:
    """Interpolate on a turned grid; beyond its borders the image is mirrored.

    Parameters
    ----------
    coefficients
        Of the spline, (row, column).
    start_px
        Position of the first sample, (xy,), px.
    steps_px
        From a sample to the next in its row, and to that below it, (2, xy), px.
    shape
        Rows and columns of the samples.
    """
    rows, columns = (np.arange(count)[:, None] for count in shape)
    position_px = start_px + columns * steps_px[0] + rows[:, None] * steps_px[1]
    return interpolate(coefficients, position_px)[0].astype(np.float32)


def noise_power(position_px: Floats) -> Floats:
    """Variance of interpolated white noise over a pixel's, at positions (..., xy): 1 on pixels, 0.76 between two."""
    fraction = np.mod(position_px, 1.0)
    along = np.polynomial.polynomial.polyval(fraction * (1 - fraction), noise_power_polynomial())
    return np.asarray(along[..., 0] * along[..., 1])


@cache
def noise_power_polynomial() -> Floats:
    """Coefficients (4,) of `noise_power` along one axis as a cubic of t (1 - t), t a pixel fraction: it is exact."""
    fraction = np.linspace(0.0, 1.0, 65)
    impulse = np.zeros((65, 65), np.float32)
    impulse[32, 32] = 1.0
    x_px = fraction[:, None] + np.arange(12, 52)
    weights, _ = interpolate(spline_coefficients(impulse), np.stack([x_px, np.full_like(x_px, 32.0)], axis=-1))
    return np.asarray(np.polynomial.polynomial.polyfit(fraction * (1 - fraction), np.sum(weights**2, axis=1), 3))


_Four: TypeAlias = tuple[float, float, float, float]


@inlined
def _weights(t: float) -> tuple[_Four, _Four]:
    """B-spline weights of four neighbours at the pixel fraction t, and their derivatives."""
    s = 1.0 - t
    weights = (s**3 / 6, 2 / 3 - t**2 + t**3 / 2, 2 / 3 - s**2 + s**3 / 2, t**3 / 6)
    slopes = (-(s**2) / 2, -2 * t + 1.5 * t**2, 2 * s - 1.5 * s**2, t**2 / 2)
    return weights, slopes


@compiled
def _prefilter(
    image: Image, coefficients: Image, counters: Counters, work: Image, lines: Image, beyond: NDArray[np.intp]
) -> None:
    """Compute strips of the coefficients (row, column), shared with the threads that have the same counters.

    `work` (strip and its run-in, column) and `lines` (2, column and reach) are places to work.
    """
    rows, columns = image.shape
    last = _STRIP + 2 * _RUN_IN - 1
    while True:
        top = take(counters) * _STRIP
        if top >= rows:
            return
        first = _mirrored_index(top - _RUN_IN, rows)
        for column in range(columns):
            work[0, column] = image[first, column]
        for row in range(1, last + 1):
            _add(image[_mirrored_index(top - _RUN_IN + row, rows)], work[row - 1], work[row])
        for row in range(last - 1, _RUN_IN - 1, -1):
            _add_to(work[row + 1], work[row])
        for row in range(min(_STRIP, rows - top)):
            source = work[row + _RUN_IN]
            for column in range(columns):
                lines[0, _REACH + column] = source[column]
            for k in range(_REACH):
                lines[0, k], lines[0, _REACH + columns + k] = source[beyond[k]], source[beyond[_REACH + k]]
            length = lines.shape[1]
            for step in range(len(_DISTANCES)):
                length -= 2 * _DISTANCES[step]
                line = coefficients[top + row] if length == columns else lines[1 - step % 2, :length]
                _convolve(lines[step % 2], _DISTANCES[step], _TAPS[step, 0], _TAPS[step, 1], line)
        finish(counters)


@inlined
def _add(row: Image, neighbour: Image, total: Image) -> None:
    for n in range(row.size):
        total[n] = row[n] + _Z * neighbour[n]


@inlined
def _add_to(neighbour: Image, row: Image) -> None:
    """Add in place; an array that is read and written under two names is not handled in vectors."""
    for n in range(row.size):
        row[n] += _Z * neighbour[n]


@inlined
def _convolve(line: Image, distance: int, middle: np.float32, others: np.float32, row: Image) -> None:
    """Convolve a line with three numbers some distance apart, which it loses at both ends."""
    left, center, right = line[: row.size], line[distance : distance + row.size], line[2 * distance :]
    for n in range(row.size):
        row[n] = middle * center[n] + others * (left[n] + right[n])


@compiled
def _mirrored_index(index: int, count: int) -> int:
    if 0 <= index < count:
        return index
    if count == 1:
        return 0
    index = abs(index) % (2 * count - 2)
    return min(index, 2 * count - 2 - index)


_WAVES = 256  # spatial frequencies that are averaged


def mean_interpolation(pixels: int) -> tuple[Floats, Floats]:
    """Values and slopes of lines, dark beyond, at random pixel fractions: matrices (pixel, pixel)."""
    cycles_per_px = (np.arange(_WAVES) + 0.5) / (2 * _WAVES)
    transfer = np.sinc(cycles_per_px) ** 4 / ((2 + np.cos(2 * np.pi * cycles_per_px)) / 3)
    angle = 2 * np.pi * cycles_per_px * np.arange(pixels)[:, None]
    values = np.mean(transfer * np.cos(angle), axis=1)
    slopes = -np.mean(transfer * 2 * np.pi * cycles_per_px * np.sin(angle), axis=1)
    return toeplitz(values), toeplitz(slopes, -slopes)
