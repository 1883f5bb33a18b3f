"""An electron-multiplying CCD: from the mean number of photons to the counts of one frame.

photons -> quantum efficiency, shot noise, dark current and clock-induced charge -> full well -> multiplication
register, when its gain is above 1 -> nonlinearity -> read noise -> offset -> converter.
The random numbers of a pixel are hashes of (seed, frame, pixel): a frame does not depend on threads or on the frames
before it. Large numbers of electrons follow Cornish-Fisher expansions, which turn one normal deviate z into a deviate
with the right mean, variance and skewness (and, for Poisson, the next order). Small numbers are drawn one by one.
"""

import math
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from threading import Thread
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import special

from reconstruction.arrays import Image
from reconstruction.runtime.threads import THREADS
from simulated_devices.optics.compiled import compiled
from simulated_devices.settings import Amplifier, SimulatedCameraSettings

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX_2 = np.uint64(0x94D049BB133111EB)
_30, _27, _31, _32 = np.uint64(30), np.uint64(27), np.uint64(31), np.uint64(32)
_LOW = np.uint64(0xFFFFFFFF)
_ONE = np.uint64(1)

_CELLS = 4096  # of the table of normal quantiles
_TAIL = 16
"""Cells at either end of the table in which the quantile is not linear enough."""
_IN_CELL, _CELL_MASK = np.uint64(20), np.uint64(0xFFFFF)  # bits that place a 32-bit number in its cell
_FIRST, _LAST = np.uint64(_TAIL), np.uint64(_CELLS - _TAIL)
_QUANTILE = special.ndtri(np.concatenate([[0.5 / _CELLS], np.arange(1, _CELLS) / _CELLS, [1 - 0.5 / _CELLS]])).astype(
    np.float32
)

_INVERSION_LIMIT = 6.0  # mean electrons up to which Poisson is drawn exactly; beyond, it is right to 0.1 %
_COMPOUND_LIMIT = 50.0  # mean electrons from which shot noise and register are one expansion, right to 0.1 %
_FEW = 4.0  # electrons up to which the register's gamma deviate is a product of uniform ones
_RECIPROCAL = 1.0 / np.maximum(np.arange(101.0), 1.0)  # a division is the slow part of the inversion


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
def _fill_normal(bits: NDArray[np.uint64], deviates: NDArray[np.float64], in_tail: NDArray[np.uint8]) -> None:
    """Fill `deviates` (N,) with `normal` of each of the `bits` (N,).

    The first loop has no branch, so that it runs on several numbers at a time. `in_tail` is scratch for a multiple of 8
    numbers, at least N.
    """
    for index in range(len(bits)):
        cell = (bits[index] & _LOW) >> _IN_CELL
        low = _QUANTILE[cell]
        fraction = (float(bits[index] & _CELL_MASK) + 0.5) * 2.0**-20
        deviates[index] = low + fraction * (_QUANTILE[cell + _ONE] - low)
        in_tail[index] = (cell < _FIRST) | (cell >= _LAST)
    words = in_tail.view(np.uint64)
    for word in range(len(words)):
        if words[word]:
            for index in range(8 * word, min(8 * word + 8, len(bits))):
                if in_tail[index]:
                    deviates[index] = _tail_normal(uniform(bits[index]))


@compiled
def poisson(mean: float, z: float, bits: np.uint64) -> float:
    """Poisson deviate: by inversion for a small mean, by Cornish-Fisher for a larger one.

    `z` is the normal deviate of the same bits.
    """
    if mean >= _INVERSION_LIMIT:
        root = math.sqrt(mean - 1 / 12)  # rounding to whole electrons adds the twelfth again
        return math.floor(mean + root * z + (z * z - 1) / 6 + (z - z * z * z) / (72 * root) + 0.5)
    u = uniform(bits)
    term = math.exp(-mean)
    total = term
    count = 0
    while u > total and count < 100:
        count += 1
        term *= mean * _RECIPROCAL[count]
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


@compiled
def _fill_many_multiplied(
    means: Image, em_gain: float, deviates: NDArray[np.float64], electrons: NDArray[np.float64]
) -> None:
    """Fill `electrons` after the register, from many `means` before it and normal deviates.

    All are (column,). Shot noise and register are one expansion, from the first three cumulants of a compound Poisson
    process.
    """
    t = math.sqrt(em_gain * (em_gain - 1))
    s = em_gain - t
    variance = s * s + 2 * s * t + 2 * t * t  # of one electron
    third = s * s * s + 3 * s * s * t + 6 * s * t * t + 6 * t * t * t
    for column in range(len(means)):
        mean, z = means[column], deviates[column]
        electrons[column] = mean * em_gain + math.sqrt(mean * variance) * z + third / (6 * variance) * (z * z - 1)


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
def expose_rows(photons: Image, key: np.uint64, chip: Chip, rows: tuple[int, int], counts: NDArray[np.uint16]) -> None:
    """Fill rows from the first to before the second of `counts` from mean `photons`, both (row, column)."""
    em_gain, full_well = chip.em_gain, chip.full_well_e
    columns = photons.shape[1]
    bits, means = np.empty(columns, np.uint64), np.empty(columns, np.float32)
    deviates, electrons = np.empty(columns), np.empty(columns)
    in_tail = np.zeros(-(-columns // 8) * 8, np.uint8)
    for row in range(rows[0], rows[1]):
        for column in range(columns):
            bits[column] = splitmix64(key ^ (np.uint64(row * columns + column) * _MIX_2))
            means[column] = photons[row, column] * chip.quantum_efficiency + chip.background_e
        _fill_normal(bits, deviates, in_tail)
        if em_gain > 1:
            _fill_many_multiplied(means, em_gain, deviates, electrons)
        for column in range(columns):
            mean = means[column]
            if em_gain > 1 and _COMPOUND_LIMIT < mean < full_well / 2:
                continue
            few = min(poisson(mean, deviates[column], bits[column]), full_well)
            electrons[column] = multiplied(few, em_gain, splitmix64(bits[column])) if em_gain > 1 and few > 0 else few
        for column in range(columns):
            bits[column] >>= _32
        _fill_normal(bits, deviates, in_tail)
        well = chip.register_full_well_e if em_gain > 1 else full_well
        for column in range(columns):
            signal = min(electrons[column], well)
            signal -= chip.loss_per_e * signal * signal
            value = (signal + chip.read_noise_e * deviates[column]) * chip.counts_per_e + chip.offset_counts
            counts[row, column] = np.uint16(min(max(value + 0.5, 0.0), chip.full_scale))


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameConditions:
    """Conditions of one frame: its number, exposure and read-out."""

    index: int
    exposure_s: float
    amplifier: Amplifier
    em_gain: float
    readout_speed: int  # of the EM amplifier


class Detector:
    """The sensor chip and its read-out; two threads share the rows of a frame."""

    def __init__(self, settings: SimulatedCameraSettings, *, seed: int) -> None:
        self._settings = settings
        self._seed = seed
        self._pool = ThreadPoolExecutor(THREADS, thread_name_prefix="detector")

    def close(self) -> None:
        """End the threads."""
        self._pool.shutdown()

    def counts(self, photons: NDArray[np.float32], exposure: FrameConditions) -> NDArray[np.uint16]:
        """Counts of one frame, (row, column), from the mean photons on each pixel during the exposure."""
        edges = [len(photons) * part // THREADS for part in range(THREADS + 1)]
        counts = np.empty(photons.shape, np.uint16)
        jobs = [self._pool.submit(self._expose, photons, exposure, rows, counts) for rows in pairwise(edges)]
        for job in jobs:
            job.result()
        return counts

    def begin(
        self, photons: Callable[[], NDArray[np.float32]], exposure: FrameConditions
    ) -> Future[NDArray[np.uint16]]:
        """Begin to compute the counts of a frame in one thread; `photons` is called there."""

        def work() -> NDArray[np.uint16]:
            received = photons()
            counts = np.empty(received.shape, np.uint16)
            self._expose(received, exposure, (0, len(received)), counts)
            return counts

        return self._pool.submit(work)

    def _expose(
        self, photons: NDArray[np.float32], exposure: FrameConditions, rows: tuple[int, int], counts: NDArray[np.uint16]
    ) -> None:
        """Fill rows of the counts; see `expose_rows`."""
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
        expose_rows(photons, key, Chip._make(map(np.float32, chip)), rows, counts)


@cache
def compile_ahead() -> None:
    """Begin to compile the detector in a thread of its own, beside the rendering of the first images."""

    def expose() -> None:
        detector = Detector(SimulatedCameraSettings(), seed=0)
        exposure = FrameConditions(index=0, exposure_s=1.0, amplifier="normal", em_gain=1.0, readout_speed=1)
        detector.begin(lambda: np.zeros((1, 1), np.float32), exposure).result()
        detector.close()

    Thread(target=expose, name="compile-detector", daemon=True).start()
