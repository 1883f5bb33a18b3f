"""Cubic B-spline interpolation of camera frames: exact at the pixels, smooth between them.

Bilinear sampling and Keys' cubic convolution bend the displacement by up to 0.2 rad of wavefront; the interpolating
B-spline (Unser 1999, IEEE Signal Processing Magazine 16, 22) does not.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import Floats, Image
from reconstruction.frame.prefilter import prefilter
from reconstruction.runtime.threads import worker_pool

_SHARED_FROM_PX = 700_000
_AT_ONCE = 20_000  # positions whose numbers fit into the processor's cache


def spline_coefficients(image: NDArray[np.uint16] | Image, *, threads: int = 1) -> Image:
    """B-spline coefficients of an image (row, column), mirrored at its borders.

    Large images are shared by several `threads`, with the same result; for small ones waking them takes too long.
    """
    light = np.require(image, np.float32, ("C", "W"))  # one kind of array is compiled once
    coefficients = np.empty(light.shape, np.float32)
    threads = 1 if light.size < _SHARED_FROM_PX else threads
    others = [
        worker_pool(threads - 1).submit(prefilter, light, coefficients, part, threads) for part in range(1, threads)
    ]
    prefilter(light, coefficients, 0, threads)
    for other in others:
        other.result()
    return coefficients


def sample(coefficients: Image, position_px: Floats) -> tuple[Floats, Floats]:
    """Interpolate at positions (..., xy) that lie inside the image.

    Returns the values (...) and their gradients (..., xy), per pixel.
    """
    values, gradients = np.empty(position_px.shape[:-1]), np.empty(position_px.shape)
    flat, flat_values, flat_gradients = position_px.reshape(-1, 2), values.reshape(-1), gradients.reshape(-1, 2)
    for first in range(0, len(flat), _AT_ONCE):
        some = slice(first, first + _AT_ONCE)
        flat_values[some], flat_gradients[some] = _sample(coefficients, flat[some])
    return values, gradients


def _sample(coefficients: Image, position_px: Floats) -> tuple[Floats, Floats]:
    rows, columns = coefficients.shape
    base = np.floor(position_px).astype(np.intp)
    weights, slopes = _weights(position_px - base)
    values = np.zeros(position_px.shape[:-1])
    gradients = np.zeros(position_px.shape)
    for i in range(4):
        row = _mirror(base[..., 1] + i - 1, rows)
        for j in range(4):
            tap = coefficients[row, _mirror(base[..., 0] + j - 1, columns)]
            values += weights[i][..., 1] * weights[j][..., 0] * tap
            gradients[..., 0] += weights[i][..., 1] * slopes[j][..., 0] * tap
            gradients[..., 1] += slopes[i][..., 1] * weights[j][..., 0] * tap
    return values, gradients


def noise_power(position_px: Floats) -> Floats:
    """Variance of an interpolated value over that of a pixel, for white noise, at positions (..., xy): (...).

    Between the pixels interpolation averages: 1 on a pixel, 0.76 in the middle between two.
    """
    fraction, power = _noise_power_table()
    along = np.interp(np.mod(position_px, 1.0), fraction, power)
    return np.asarray(along[..., 0] * along[..., 1])


def noise_power_polynomial() -> Floats:
    """The same along one axis, as a cubic polynomial of t (1 - t), t the fraction of a pixel: rising powers, (4,)."""
    fraction, power = _noise_power_table()
    return np.asarray(np.polynomial.polynomial.polyfit(fraction * (1 - fraction), power, 3))


@cache
def _noise_power_table() -> tuple[Floats, Floats]:
    """Fractions of a pixel, and the sum of the squared weights of all pixels in a value interpolated there."""
    fraction = np.linspace(0.0, 1.0, 65)
    impulse = np.zeros((65, 65), np.float32)
    impulse[32, 32] = 1.0
    x_px = fraction[:, None] + np.arange(12, 52)
    weights, _ = sample(spline_coefficients(impulse), np.stack([x_px, np.full_like(x_px, 32.0)], axis=-1))
    return fraction, np.sum(weights**2, axis=1)


def _weights(t: Floats) -> tuple[tuple[Floats, ...], tuple[Floats, ...]]:
    """The four B-spline weights at the fraction t of a pixel, and their derivatives."""
    s = 1.0 - t
    weights = (s**3 / 6, 2 / 3 - t**2 + t**3 / 2, 2 / 3 - s**2 + s**3 / 2, t**3 / 6)
    slopes = (-(s**2) / 2, -2 * t + 1.5 * t**2, 2 * s - 1.5 * s**2, t**2 / 2)
    return weights, slopes


def _mirror(index: NDArray[np.intp], count: int) -> NDArray[np.intp]:
    """Reflect indices about the first and last pixel, as the prefilter did."""
    index = np.abs(index)
    return (count - 1) - np.abs((count - 1) - index)
