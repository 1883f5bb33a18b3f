"""The random life of the electrons of one pixel, compiled: the inner loop of the detector.

Large numbers of electrons follow Cornish-Fisher expansions, which turn one normal deviate z into a deviate with the
right mean, variance and skewness (and, for Poisson, the next order): a few operations instead of a
thousand. Small numbers are drawn one by one.
"""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import special

from simulated_devices.compiled import compiled

Images: TypeAlias = NDArray[np.float32]

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX_2 = np.uint64(0x94D049BB133111EB)
_30, _27, _31, _32 = np.uint64(30), np.uint64(27), np.uint64(31), np.uint64(32)
_LOW = np.uint64(0xFFFFFFFF)

_CELLS = 4096
_TAIL = 16
"""Cells at either end of the table where the quantile bends too much for a straight line."""
_QUANTILE = special.ndtri(np.concatenate([[0.5 / _CELLS], np.arange(1, _CELLS) / _CELLS, [1 - 0.5 / _CELLS]])).astype(
    np.float32
)

_INVERSION_LIMIT = np.float32(12)  # mean electrons up to which Poisson is drawn exactly
_GAUSSIAN_LIMIT = np.float32(200)  # mean electrons from which shot noise and register are one expansion
_FEW = 12  # electrons up to which the register's gamma deviate is a product of uniform ones


@compiled
def splitmix64(state: np.uint64) -> np.uint64:
    """64 well mixed bits from any 64 bits (Steele, Lea & Flood 2014)."""
    z = state + _GOLDEN
    z = (z ^ (z >> _30)) * _MIX_1
    z = (z ^ (z >> _27)) * _MIX_2
    return z ^ (z >> _31)


@compiled
def _uniform(bits: np.uint64) -> np.float32:
    """Uniform deviate strictly between 0 and 1 from the lower 32 bits."""
    return np.float32((np.float64(bits & _LOW) + 0.5) * 2.0**-32)


@compiled
def _normal(bits: np.uint64) -> np.float32:
    """Normal deviate from the lower 32 bits: tabulated quantiles, straight lines between them, exact in the tails."""
    position = np.float64(bits & _LOW) * (_CELLS * 2.0**-32)
    cell = int(position)
    if cell < _TAIL or cell >= _CELLS - _TAIL:
        return _tail_normal((np.float64(bits & _LOW) + 0.5) * 2.0**-32)
    return _QUANTILE[cell] + np.float32(position - cell) * (_QUANTILE[cell + 1] - _QUANTILE[cell])


@compiled
def _tail_normal(probability: np.float64) -> np.float32:
    """Quantile of the normal distribution far from its middle (Giles 2010, the branch for w > 5 and its neighbour)."""
    x = 2.0 * probability - 1.0
    w = -math.log((1.0 - x) * (1.0 + x))
    if w < 5.0:
        w -= 2.5
        p = 2.81022636e-08
        p = 3.43273939e-07 + p * w
        p = -3.5233877e-06 + p * w
        p = -4.39150654e-06 + p * w
        p = 0.00021858087 + p * w
        p = -0.00125372503 + p * w
        p = -0.00417768164 + p * w
        p = 0.246640727 + p * w
        p = 1.50140941 + p * w
    else:
        w = math.sqrt(w) - 3.0
        p = -0.000200214257
        p = 0.000100950558 + p * w
        p = 0.00134934322 + p * w
        p = -0.00367342844 + p * w
        p = 0.00573950773 + p * w
        p = -0.0076224613 + p * w
        p = 0.00943887047 + p * w
        p = 1.00167406 + p * w
        p = 2.83297682 + p * w
    return np.float32(math.sqrt(2.0) * p * x)


@compiled
def poisson(mean: np.float32, bits: np.uint64) -> np.float32:
    """Poisson deviate: by inversion for a small mean, by Cornish-Fisher to order 1/mean for a larger one."""
    if mean < _INVERSION_LIMIT:
        if mean <= 0:
            return np.float32(0)
        u = np.float64(bits >> np.uint64(11)) * 2.0**-53
        term = math.exp(-np.float64(mean))
        total = term
        count = 0
        while u > total and count < 100:
            count += 1
            term *= mean / count
            total += term
        return np.float32(count)
    z = _normal(bits)
    root = np.sqrt(mean)
    return np.floor(mean + root * z + (z * z - 1) / 6 + (z - z * z * z) / (72 * root) + np.float32(0.5))


@compiled
def multiplied(electrons: np.float32, em_gain: np.float32, key: np.uint64) -> np.float32:
    """Electrons behind the multiplication register, for a whole number before it.

    One electron becomes a geometrically distributed number of mean G (a pure birth process), variance G (G - 1); n of
    them are drawn as n (G - t) plus a gamma deviate of shape n and scale t = sqrt(G (G - 1)): same mean and variance.
    """
    scale = np.sqrt(em_gain * (em_gain - 1))
    if electrons <= _FEW:
        product = 1.0
        for draw in range(int(electrons)):
            product *= _uniform(splitmix64(key + np.uint64(draw)))
        gamma = -math.log(product)
    else:  # Wilson & Hilferty 1931: the cube root of a gamma deviate is nearly normal
        ninth = 1 / (9 * electrons)
        root = 1 - ninth + _normal(splitmix64(key)) * np.sqrt(ninth)
        gamma = electrons * root * root * root
    return np.float32(electrons * (em_gain - scale) + scale * gamma)


@compiled
def _bright_multiplied(mean: np.float32, em_gain: np.float32, z: np.float32) -> np.float32:
    """Shot noise and register in one expansion, from the first three cumulants of a compound Poisson process."""
    t = np.sqrt(em_gain * (em_gain - 1))
    s = em_gain - t
    variance = mean * (s * s + 2 * s * t + 2 * t * t)
    third = mean * (s * s * s + 3 * s * s * t + 6 * s * t * t + 6 * t * t * t)
    return mean * em_gain + np.sqrt(variance) * z + third / (6 * variance) * (z * z - 1)


@compiled
def expose_rows(
    photons: Images, key: np.uint64, parameters: Images, start: int, end: int, counts: NDArray[np.uint16]
) -> None:
    """Fill rows start ... end of `counts` from mean `photons` (row, column); `parameters` as `Detector` lists them."""
    efficiency, background, full_well, em_gain, register_well, read_noise, per_electron, offset, top = parameters
    columns = photons.shape[1]
    for row in range(start, end):
        for column in range(columns):
            bits = splitmix64(key ^ (np.uint64(row * columns + column) * _MIX_2))
            mean = photons[row, column] * efficiency + background
            if em_gain > 1 and mean > _GAUSSIAN_LIMIT and mean < full_well / 2:
                electrons = _bright_multiplied(mean, em_gain, _normal(bits))
            else:
                electrons = min(poisson(mean, bits if mean >= _INVERSION_LIMIT else splitmix64(bits)), full_well)
                if em_gain > 1 and electrons > 0:
                    electrons = multiplied(electrons, em_gain, splitmix64(bits ^ _MIX_1))
            if em_gain > 1:
                electrons = min(electrons, register_well)
            value = (electrons + read_noise * _normal(bits >> _32)) * per_electron + offset
            counts[row, column] = np.uint16(min(max(value + np.float32(0.5), np.float32(0)), top))
