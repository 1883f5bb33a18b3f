"""Cubic B-spline interpolation of camera frames (Unser 1999, IEEE Signal Processing Magazine 16, 22).

Bilinear sampling and Keys' cubic convolution distort the wavefront by up to 0.2 rad; the interpolating B-spline does
not. With z = sqrt(3) - 2 and x the shift by a pixel, its prefilter is -6 z / ((1 - z/x) (1 - z x)): recursive along
columns, all columns of a row at once; along rows a convolution with (1 + z) / (1 - z) z^|k| is faster.

Interpolation at the fraction f of a pixel multiplies the wave exp(2 pi i nu x) by
sum_j B(j - f) exp(2 pi i nu (j - f)) / sum_j B(j) exp(2 pi i nu j), B the cubic B-spline. Its mean over all fractions,
sinc(nu)^4 / ((2 + cos(2 pi nu)) / 3), blurs a displaced image.
"""

from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import toeplitz

from reconstruction.arrays import Floats, Image
from reconstruction.runtime.compilation import compiled
from reconstruction.runtime.threads import worker_pool

_SHARED_FROM_PX = 150_000  # below, waking threads takes longer than they save
_CHUNK = 20_000  # positions per call, whose arrays fit into the processor's cache
_POLE = np.sqrt(3.0) - 2.0
_REACH = 10
_RESPONSE = _POLE ** np.arange(_REACH + 1)
_Z = np.float32(_POLE)
# The recursion multiplies a constant by 1 / (1 - z)^2; the response along rows divides by it.
_TAPS = (_RESPONSE / (2 * _RESPONSE.sum() - 1) * (1 - _POLE) ** 2).astype(np.float32)
_RUN_IN = 14  # extra rows on both sides of a strip, after which the recursion has forgotten its start
_STRIP = 64  # rows; fixed, so that the result does not depend on the number of threads


def spline_coefficients(image: NDArray[np.uint16] | Image, *, threads: int = 1) -> Image:
    """B-spline coefficients of an image (row, column), mirrored at its borders; the same for any number of threads."""
    light = np.require(image, np.float32, ("C", "W"))  # so that Numba compiles one signature only
    coefficients = np.empty(light.shape, np.float32)
    threads = 1 if light.size < _SHARED_FROM_PX else threads
    others = [
        worker_pool(threads - 1).submit(_prefilter, light, coefficients, part, threads) for part in range(1, threads)
    ]
    _prefilter(light, coefficients, 0, threads)
    for other in others:
        other.result()
    return coefficients


def sample(coefficients: Image, position_px: Floats) -> tuple[Floats, Floats]:
    """Interpolate at positions (..., xy) inside the image: values (...) and gradients (..., xy) per pixel."""
    values, gradients = np.empty(position_px.shape[:-1]), np.empty(position_px.shape)
    flat, flat_values, flat_gradients = position_px.reshape(-1, 2), values.reshape(-1), gradients.reshape(-1, 2)
    for first in range(0, len(flat), _CHUNK):
        some = slice(first, first + _CHUNK)
        flat_values[some], flat_gradients[some] = _sample(coefficients, flat[some])
    return values, gradients


def _sample(coefficients: Image, position_px: Floats) -> tuple[Floats, Floats]:
    rows, columns = coefficients.shape
    base = np.floor(position_px).astype(np.intp)
    weights, slopes = _weights(position_px - base)
    values = np.zeros(position_px.shape[:-1])
    gradients = np.zeros(position_px.shape)
    for i in range(4):
        row = _mirrored(base[..., 1] + i - 1, rows)
        for j in range(4):
            tap = coefficients[row, _mirrored(base[..., 0] + j - 1, columns)]
            values += weights[i][..., 1] * weights[j][..., 0] * tap
            gradients[..., 0] += weights[i][..., 1] * slopes[j][..., 0] * tap
            gradients[..., 1] += slopes[i][..., 1] * weights[j][..., 0] * tap
    return values, gradients


def noise_power(position_px: Floats) -> Floats:
    """Variance of an interpolated value over that of a pixel, for white noise, at positions (..., xy): (...).

    It is 1 on a pixel and 0.76 halfway between two, because interpolation averages.
    """
    fraction, power = _noise_power_table()
    along = np.interp(np.mod(position_px, 1.0), fraction, power)
    return np.asarray(along[..., 0] * along[..., 1])


def noise_power_polynomial() -> Floats:
    """Coefficients (4,), rising powers, of `noise_power` along one axis as a cubic of t (1 - t), t a pixel fraction."""
    fraction, power = _noise_power_table()
    return np.asarray(np.polynomial.polynomial.polyfit(fraction * (1 - fraction), power, 3))


@cache
def _noise_power_table() -> tuple[Floats, Floats]:
    """Fractions of a pixel, and the sum of the squared pixel weights of a value interpolated there."""
    fraction = np.linspace(0.0, 1.0, 65)
    impulse = np.zeros((65, 65), np.float32)
    impulse[32, 32] = 1.0
    x_px = fraction[:, None] + np.arange(12, 52)
    weights, _ = sample(spline_coefficients(impulse), np.stack([x_px, np.full_like(x_px, 32.0)], axis=-1))
    return fraction, np.sum(weights**2, axis=1)


def _weights(t: Floats) -> tuple[tuple[Floats, ...], tuple[Floats, ...]]:
    """B-spline weights of four neighbours at the pixel fraction t, and their derivatives."""
    s = 1.0 - t
    weights = (s**3 / 6, 2 / 3 - t**2 + t**3 / 2, 2 / 3 - s**2 + s**3 / 2, t**3 / 6)
    slopes = (-(s**2) / 2, -2 * t + 1.5 * t**2, 2 * s - 1.5 * s**2, t**2 / 2)
    return weights, slopes


def _mirrored(index: NDArray[np.intp], count: int) -> NDArray[np.intp]:
    index = np.abs(index)
    return (count - 1) - np.abs((count - 1) - index)


@compiled
def _prefilter(image: Image, coefficients: Image, first: int, step: int) -> None:
    """Compute every `step`-th strip of the coefficients (row, column), starting with strip `first`."""
    rows, columns = image.shape
    work = np.empty((_STRIP + 2 * _RUN_IN, columns), np.float32)
    line = np.empty(columns + 2 * _REACH, np.float32)
    beyond = np.array([_mirrored_index(k, columns) for k in range(-_REACH, columns + _REACH) if not 0 <= k < columns])
    for top in range(first * _STRIP, rows, step * _STRIP):
        bottom = min(top + _STRIP, rows)
        last = bottom - top + 2 * _RUN_IN - 1
        work[0] = image[_mirrored_index(top - _RUN_IN, rows)]
        for row in range(1, last + 1):
            _add(image[_mirrored_index(top - _RUN_IN + row, rows)], work[row - 1], work[row])
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
    """Convolve a line, padded by the reach of the response on both sides."""
    for n in range(row.size):
        total = _TAPS[0] * line[n + _REACH]
        for k in range(1, _REACH + 1):
            total += _TAPS[k] * (line[n + _REACH - k] + line[n + _REACH + k])
        row[n] = total


@compiled
def _mirrored_index(index: int, count: int) -> int:
    if count == 1:
        return 0
    index = abs(index) % (2 * count - 2)
    return min(index, 2 * count - 2 - index)


_WAVES = 256


def mean_interpolation(pixels: int) -> tuple[Floats, Floats]:
    """Values and slopes of lines of pixels after interpolation at random fractions: matrices (pixel, pixel).

    Beyond its ends a line is dark.
    """
    cycles_per_px = (np.arange(_WAVES) + 0.5) / (2 * _WAVES)
    transfer = np.sinc(cycles_per_px) ** 4 / ((2 + np.cos(2 * np.pi * cycles_per_px)) / 3)
    angle = 2 * np.pi * cycles_per_px * np.arange(pixels)[:, None]
    values = np.mean(transfer * np.cos(angle), axis=1)
    slopes = -np.mean(transfer * 2 * np.pi * cycles_per_px * np.sin(angle), axis=1)
    return toeplitz(values), toeplitz(slopes, -slopes)
