"""Strength of the smoothness prior and noise level, by the evidence of the data.

MacKay, Neural Computation 4, 415 (1992).
"""

import math
from typing import NamedTuple

import numpy as np

from reconstruction.arrays import Floats
from reconstruction.runtime.compilation import compiled


class FitQuality(NamedTuple):
    """How well a model explains the displacements of a frame."""

    log_evidence: float  # up to a constant common to all models of a frame
    chi_square: float  # reduced, of the displacements about the fit, in units of their expected errors
    misfit: float  # RMS of the displacements not explained over that of all, both in expected errors


# Ratios of prior to noise variance tried: every decade, then every quarter of a decade about the best.
_PRIOR_DECADES = np.linspace(-4.0, 14.0, 19)
_BETWEEN_DECADES = np.linspace(-0.75, 0.75, 7)
_SIGNAL = 1000.0  # least expected variance of the displacements over that of their noise
_TINY = np.finfo(np.float64).tiny
_FACTORS = 16  # factors of up to 1e15, whose product does not overflow, per logarithm


def prior_and_noise(square: Floats, along: Floats, total: float, count: int) -> tuple[float, float]:
    """Ratio of prior to noise variance for a solution, and noise variance; arguments as in `maximize_evidence`.

    The evidence of a weak wavefront allows any prior down to none, which would shrink the wavefront and its error bars
    to nothing. So the prior expects at least `_SIGNAL` times the noise in the displacements.
    """
    ratio, noise = maximize_evidence(square, along, total, count)
    return max(ratio, _SIGNAL * count / max(float(np.sum(square)), _TINY)), noise


@compiled
def maximize_evidence(square: Floats, along: Floats, total: float, count: int) -> tuple[float, float]:
    """Most probable ratio of prior to noise variance, and noise variance.

    `square` (n,): squared singular values, at most 1; `along` (n,): the `count` data along the singular vectors;
    `total`: their sum of squares. Component n has the variance noise (1 + ratio square_n), the rest only noise. The
    noise follows from the ratio in closed form; its variance is at least 1, that of the expected errors.
    """
    energy = along**2
    beyond = max(total - np.sum(energy), 0.0)
    decade, most_probable = 0.0, 0.0
    for tried in (_PRIOR_DECADES, _BETWEEN_DECADES):
        around, best = decade, -np.inf
        for between in tried:
            evidence, noise = _evidence(10.0 ** (around + between), square, energy, beyond, count)
            if evidence > best:
                best, decade, most_probable = evidence, around + between, noise
    return 10.0**decade, most_probable


def log_evidence(ratio: float, square: Floats, along: Floats, total: float, count: int) -> float:
    """Log evidence of a ratio of prior to noise variance, up to a constant; arguments as in `maximize_evidence`."""
    evidence, _ = _evidence(ratio, square, along**2, max(total - float(along @ along), 0.0), count)
    return float(evidence)


def fit_quality(ratio: float, square: Floats, along: Floats, total: float, count: int) -> FitQuality:
    """Quality of the fit with a ratio of prior to noise variance; arguments as in `maximize_evidence`."""
    kept = ratio * square / (1 + ratio * square)
    left = max(total - float(np.sum(along**2 * (1 - (1 - kept) ** 2))), 0.0)
    chi_square = left / max(count - float(np.sum(kept)), 1.0)
    evidence = log_evidence(ratio, square, along, total, count)
    return FitQuality(evidence, chi_square, math.sqrt(left / total) if total > 0 else 0.0)


@compiled
def _evidence(ratio: float, square: Floats, energy: Floats, beyond: float, count: int) -> tuple[float, float]:
    """Log evidence of one ratio, up to a constant, and the most probable noise variance."""
    spread = 1.0 + ratio * square
    total = np.sum(energy / spread) + beyond
    noise = max(total / count, 1.0)
    evidence = -(count * np.log(noise) + total / noise) / 2
    for first in range(0, spread.size, _FACTORS):
        evidence -= np.log(np.prod(spread[first : first + _FACTORS])) / 2
    return evidence, noise
