"""An electron-multiplying CCD: from the mean number of photons to the counts of one frame.

photons -> quantum efficiency, shot noise, dark current and clock-induced charge -> full well -> multiplication
register, when its gain is above 1 -> nonlinearity -> read noise -> offset -> converter.
The random numbers of a pixel are hashes of (seed, frame, pixel): a frame does not depend on the frames
before it. Large numbers of electrons follow Cornish-Fisher expansions, which turn one normal deviate z into a deviate
with the right mean, variance and skewness (and, for Poisson, the next order). Small numbers are drawn one by one.
Where nothing between shot noise and read noise is nonlinear, one deviate represents both: their cumulants add up.
"""

import math
from dataclasses import dataclass
from functools import cache
from threading import Thread
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import special

from drivers.interface import BadValue
from reconstruction.arrays import Image
from simulated_devices.optics.compiled import compiled
from simulated_devices.settings import Amplifier, SimulatedCameraSettings

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX_2 = np.uint64(0x94D049BB133111EB)
_30, _27, _31, _32 = np.uint64(30), np.uint64(27), np.uint64(31), np.uint64(32)
_LOW = np.uint64(0xFFFFFFFF)

_CELLS = 4096  # of the table of normal quantiles
_TAIL = 16
"""Cells at either end of the table in which the quantile is not linear enough."""
_QUANTILE = special.ndtri(np.concatenate([[0.5 / _CELLS], np.arange(1, _CELLS) / _CELLS, [1 - 0.5 / _CELLS]])).astype(
    np.float32
)

_INVERSION_LIMIT = 6.0  # mean electrons up to which Poisson is drawn exactly; beyond, it is right to 0.1 %
_MOST_SKEWNESS, _MOST_EXCESS = np.float32(0.3 / 6), np.float32(0.15 / 24)
"""Of all noise, with the factors of the expansion, up to which it is one expansion, right to 0.1 %."""
_NUMBERS = tuple(np.float32(number) for number in (0, 1, 2, 3, 5))
_FEW = 4.0  # electrons up to which the register's gamma deviate is a product of uniform ones


@compiled
def splitmix64(state: np.uint64) -> np.uint64:
    """64 well mixed bits from any 64 bits (Steele, Lea & Flood 2014)."""
    z = state + _GOLDEN
    z = (z ^ (z >> _30)) * _MIX_1
    z = (z ^ (z >> _27)) * _MIX_2
    return z ^ (z >> _31)


@compiled
def uniform(bits: np.uint64) -> float:
    """Uniform deviate strictly between 0 and 1 from the lower 32 bits."""
    return (float(bits & _LOW) + 0.5) * 2.0**-32


@compiled
def normal(bits: np.uint64) -> float:
    """Normal deviate from the lower 32 bits: tabulated quantiles, linear interpolation, exact tails."""
    position = uniform(bits) * _CELLS
    cell = int(position)
    if cell < _TAIL or cell >= _CELLS - _TAIL:
        return _tail_normal(uniform(bits))
    low = _QUANTILE[cell]
    return float(low + (position - cell) * (_QUANTILE[cell + 1] - low))


@compiled
def _tail_normal(probability: float) -> float:
    """Quantile of a normal distribution's tails, a rational approximation (Acklam 2003; relative 1.2e-9)."""
    q = math.sqrt(-2.0 * math.log(min(probability, 1.0 - probability)))
    numerator = -7.784894002430293e-03 * q - 3.223964580411365e-01
    numerator = (numerator * q - 2.400758277161838) * q - 2.549732539343734
    numerator = (numerator * q + 4.374664141464968) * q + 2.938163982698783
    denominator = (7.784695709041462e-03 * q + 3.224671290700398e-01) * q + 2.445134137142996
    denominator = (denominator * q + 3.754408661907416) * q + 1.0
    lower = numerator / denominator
    return lower if probability < 0.5 else -lower


@compiled
def _hash(state: np.uint32) -> np.uint32:
    """32 well mixed bits from any 32 bits (Wellons 2018), several at a time."""
    x = np.uint32(state ^ (state >> np.uint32(16)))
    x = np.uint32(x * np.uint32(0x7FEB352D))
    x = np.uint32(x ^ (x >> np.uint32(15)))
    x = np.uint32(x * np.uint32(0x846CA68B))
    return np.uint32(x ^ (x >> np.uint32(16)))


@compiled
def _fill_normal(
    first: int, key: np.uint64, deviates: Image, bits: NDArray[np.uint32], in_tail: NDArray[np.int64]
) -> None:
    """Fill `deviates` (N,) of the pixels from the `first` on; `bits` (N,) and `in_tail` (N + 1,) are scratch.

    No loop but the last has a branch, so that they run on several numbers at a time.
    """
    low_key, high_key = np.uint32(key & _LOW), np.uint32(key >> _32)
    for index in range(len(bits)):
        bits[index] = _hash(np.uint32(_hash(np.uint32(np.uint32(first + index) ^ low_key)) + high_key))
    for index in range(len(bits)):
        cell = bits[index] >> np.uint32(20)
        low = _QUANTILE[cell]
        fraction = (np.float32(bits[index] & np.uint32(0xFFFFF)) + np.float32(0.5)) * np.float32(2.0**-20)
        deviates[index] = low + fraction * (_QUANTILE[cell + np.uint32(1)] - low)
    tails = np.int64(0)
    for index in range(len(bits)):
        in_tail[tails] = index
        tails += np.uint32((bits[index] >> np.uint32(20)) - np.uint32(_TAIL)) >= np.uint32(_CELLS - 2 * _TAIL)
    for tail in range(tails):
        deviates[in_tail[tail]] = _tail_normal((float(bits[in_tail[tail]]) + 0.5) * 2.0**-32)


@compiled
def poisson(mean: float, z: float, bits: np.uint64) -> float:
    """Poisson deviate: by inversion for a small mean, else from normal `z` of the same bits (Cornish-Fisher)."""
    if mean >= _INVERSION_LIMIT:
        root = math.sqrt(mean - 1 / 12)  # rounding to whole electrons adds the twelfth again
        return math.floor(mean + root * z + (z * z - 1) / 6 + (z - z * z * z) / (72 * root) + 0.5)
    u = uniform(bits)
    term = math.exp(-mean)
    total = term
    count = 0
    while u > total and count < 100:
        count += 1
        term *= mean / count
        total += term
    return float(count)


@compiled
def multiplied(electrons: float, em_gain: float, key: np.uint64) -> float:
    """Electrons after the multiplication register, from a whole number before it.

    One electron becomes a geometrically distributed number of mean G (a pure birth process), variance G (G - 1); n of
    them are drawn as n (G - t) plus a gamma deviate of shape n and scale t = sqrt(G (G - 1)): same mean and variance.
    """
    scale = math.sqrt(em_gain * (em_gain - 1))
    if electrons <= _FEW:
        product = 1.0
        for draw in range(int(electrons)):
            product *= uniform(splitmix64(key + np.uint64(draw)))
        gamma = -math.log(product)
    else:  # Wilson & Hilferty 1931: the cube root of a gamma deviate is nearly normal
        ninth = 1 / (9 * electrons)
        root = 1 - ninth + normal(splitmix64(key)) * math.sqrt(ninth)
        gamma = electrons * root * root * root
    return electrons * (em_gain - scale) + scale * gamma


class Chip(NamedTuple):
    """The sensor chip in one frame; `expose_rows` takes its numbers in single precision."""

    quantum_efficiency: float
    background_e: float  # mean of dark current and clock-induced charge
    full_well_e: float
    em_gain: float  # 1 without the register
    register_full_well_e: float
    loss_per_e: float  # share that the nonlinearity takes of a signal, for each electron of it
    read_noise_e: float
    counts_per_e: float
    offset_counts: float
    full_scale: float


@compiled
def _moments(em_gain: float) -> tuple[float, float, float]:
    """Second to fourth moment of the electrons that one becomes in the register; all 1 without gain."""
    t = math.sqrt(em_gain * (em_gain - 1))
    s = em_gain - t
    second = s * s + 2 * s * t + 2 * t * t
    third = s * s * s + 3 * s * s * t + 6 * s * t * t + 6 * t * t * t
    return second, third, s**4 + 4 * s**3 * t + 12 * s * s * t * t + 24 * s * t**3 + 24 * t**4


@compiled
def _expose_pixel(mean: float, bits: np.uint64, chip: Chip) -> np.uint16:
    """Counts of a pixel from its mean electrons, step by step."""
    em_gain = float(chip.em_gain)
    electrons = min(poisson(mean, normal(bits), bits), float(chip.full_well_e))
    if em_gain > 1 and electrons > 0:
        electrons = multiplied(electrons, em_gain, splitmix64(bits))
    signal = min(electrons, float(chip.register_full_well_e if em_gain > 1 else chip.full_well_e))
    signal -= chip.loss_per_e * signal * signal
    value = (signal + chip.read_noise_e * normal(bits >> _32)) * chip.counts_per_e + chip.offset_counts
    return np.uint16(min(max(value + 0.5, 0.0), float(chip.full_scale)))


@compiled
def expose_rows(image: Image, dose: np.float32, key: np.uint64, chip: Chip, counts: NDArray[np.uint16]) -> None:
    """Fill `counts`, (row, column), from mean photons, `image` x `dose`, a row at a time in single precision."""
    columns, zero, one, two, three, five = image.shape[1], *_NUMBERS
    variance, third, fourth = _moments(chip.em_gain)
    second_e, third_e, fourth_e = np.float32(variance), np.float32(third / 6), np.float32(fourth / 24)
    read_variance, half = chip.read_noise_e * chip.read_noise_e, np.float32(0.5)
    most_skew, most_excess = _MOST_SKEWNESS, _MOST_EXCESS
    highest = min(chip.full_well_e, chip.register_full_well_e / chip.em_gain) * half
    if chip.loss_per_e != 0 or chip.read_noise_e < 1:
        highest = zero  # step by step
    means, deviates = np.empty(columns, np.float32), np.empty(columns, np.float32)
    bits, in_tail = np.empty(columns, np.uint32), np.empty(columns + 1, np.int64)
    for row in range(len(image)):
        _fill_normal(row * columns, key, deviates, bits, in_tail)
        others = 0
        for column in range(columns):
            mean, z = image[row, column] * dose * chip.quantum_efficiency + chip.background_e, deviates[column]
            total, square = mean * second_e + read_variance, z * z
            root, inverse = np.sqrt(total), one / total
            skewness, excess = mean * third_e * root * inverse * inverse, mean * fourth_e * inverse * inverse
            z += skewness * (square - one) + z * (
                excess * (square - three) - skewness * skewness * (two * square - five)
            )
            value = (mean * chip.em_gain + root * z) * chip.counts_per_e + chip.offset_counts
            counts[row, column] = np.uint16(min(max(value + half, zero), chip.full_scale))
            others += (skewness > most_skew) | (excess > most_excess) | (mean >= highest)
            means[column] = mean
        if others:
            for column in range(columns):
                mean = means[column]
                total = mean * second_e + read_variance
                is_skewed = mean * third_e > most_skew * total * np.sqrt(total)
                if is_skewed or mean * fourth_e > most_excess * total * total or mean >= highest:
                    own = splitmix64(key ^ (np.uint64(row * columns + column) * _MIX_2))
                    counts[row, column] = _expose_pixel(float(mean), own, chip)


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameConditions:
    """Conditions of one frame: its number, exposure and read-out."""

    index: int
    exposure_s: float
    amplifier: Amplifier
    em_gain: float
    readout_speed: int  # of the EM amplifier


class Detector:
    """The sensor chip and its read-out."""

    def __init__(self, settings: SimulatedCameraSettings, *, seed: int) -> None:
        if settings.offset_counts >= 2**settings.bits:  # no fault of a bench, whose frames may be files
            raise BadValue(f"camera.offset_counts = {settings.offset_counts:g} must be below {2**settings.bits}")
        self._settings = settings
        self._seed = seed

    def counts(
        self, image: NDArray[np.float32], exposure: FrameConditions, *, dose: np.float32 = _NUMBERS[1]
    ) -> NDArray[np.uint16]:
        """Counts of one frame, (row, column), from the mean photons on each pixel during it, `image` x `dose`."""
        settings, is_em = self._settings, exposure.amplifier == "em"
        background_e = settings.dark_current_e_per_s * exposure.exposure_s + settings.clock_induced_charge_e
        read_noise_e = settings.em_read_noise_e[exposure.readout_speed - 1] if is_em else settings.normal_read_noise_e
        chip = Chip(
            quantum_efficiency=settings.quantum_efficiency,
            background_e=background_e,
            full_well_e=settings.full_well_e,
            em_gain=exposure.em_gain if is_em else 1.0,
            register_full_well_e=settings.register_full_well_e,
            loss_per_e=settings.loss_per_e,
            read_noise_e=read_noise_e,
            counts_per_e=1 / settings.electrons_per_count,
            offset_counts=settings.offset_counts,
            full_scale=2**settings.bits - 1,
        )
        hashed_seed = int(splitmix64(np.uint64(self._seed)))  # Numba returns it as Python's integer
        key = np.uint64(splitmix64(np.uint64((hashed_seed + exposure.index) % 2**64)))
        counts = np.empty(image.shape, np.uint16)
        expose_rows(image, dose, key, Chip._make(map(np.float32, chip)), counts)
        return counts


@cache
def compile_ahead() -> None:
    """Begin to compile the detector in a thread of its own, during the rendering of the first images."""

    def expose() -> None:
        exposure = FrameConditions(index=0, exposure_s=1.0, amplifier="normal", em_gain=1.0, readout_speed=1)
        Detector(SimulatedCameraSettings(), seed=0).counts(np.zeros((1, 1), np.float32), exposure)

    Thread(target=expose, name="compile-detector", daemon=True).start()
