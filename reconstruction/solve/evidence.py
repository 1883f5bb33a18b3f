"""Strength of the smoothness prior and noise level, by the evidence of the data.

MacKay, Neural Computation 4, 415 (1992).
"""

import math
from typing import NamedTuple

import numpy as np

from reconstruction.arrays import Floats
from reconstruction.runtime.compilation import compiled

# Ratios of prior to noise variance tried: every decade, then every quarter of a decade about the best.
_PRIOR_DECADES = np.linspace(-4.0, 14.0, 19)
_BETWEEN_DECADES = np.linspace(-0.75, 0.75, 7)
_SIGNAL = 1000.0  # least expected variance of the displacements over that of their noise
_TINY = np.finfo(np.float64).tiny
_FACTORS = 16  # factors of up to 1e15, whose product does not overflow, per logarithm


class FitQuality(NamedTuple):
    """Quality of the fit of a model to the displacements of a frame."""

    log_evidence: float  # up to a constant common to all models of a frame
    chi_square: float  # reduced, of the displacements about the fit, in units of their expected errors
    misfit: float  # RMS of the displacements not explained over that of all, both in expected errors


class Estimate(NamedTuple):
    """Most probable components of one frame."""

    values: Floats  # (n,)
    ratio: float  # of the prior's variance to that of the noise; infinite without a prior
    noise: float  # variance of the noise over that of the expected errors
    freedom: float  # number of data minus that of the components which they determine


class Components(NamedTuple):
    """A frame's whitened data in independent components x: along = singular x + noise."""

    singular: Floats  # (n,); 0 for what the data do not show
    along: Floats  # the data along the singular vectors, (n,)
    total: float  # sum of squares of the data
    number: int  # of data

    def estimate(self) -> Estimate:
        """Estimate x with a prior whose strength maximises the evidence.

        The evidence of a weak wavefront allows any prior down to none, which would shrink the wavefront and its error
        bars to nothing. So the prior expects at least `_SIGNAL` times the noise in the displacements.
        """
        square = self.singular**2
        relative = square / np.max(square)
        ratio, noise = _maximize_evidence(relative, self.along**2, self.total, self.number)
        ratio = max(ratio, _SIGNAL * self.number / max(float(np.sum(relative)), _TINY)) / np.max(square)
        variance = ratio / (1 + ratio * square)  # over that of the noise
        freedom = self.number - float(np.sum(variance * square))
        return Estimate(variance * self.singular * self.along, float(ratio), noise, freedom)

    def quality(self) -> FitQuality:
        """Quality of the fit with the most probable strength of the prior."""
        relative = (self.singular / np.max(self.singular)) ** 2
        ratio, _ = _maximize_evidence(relative, self.along**2, self.total, self.number)
        kept, energy = ratio * relative / (1 + ratio * relative), self.along**2
        left = max(self.total - float(np.sum(energy * (1 - (1 - kept) ** 2))), 0.0)
        chi_square = left / max(self.number - float(np.sum(kept)), 1.0)
        beyond = max(self.total - float(self.along @ self.along), 0.0)
        log_evidence, _ = _evidence(ratio, relative, energy, beyond, self.number)
        return FitQuality(float(log_evidence), chi_square, math.sqrt(left / self.total) if self.total > 0 else 0.0)


@compiled
def _maximize_evidence(square: Floats, energy: Floats, total: float, count: int) -> tuple[float, float]:
    """Most probable ratio of prior to noise variance, and noise variance.

    Component n, with the squared singular value `square` (n,), at most 1, and the `energy` (n,) of its data, has the
    variance noise (1 + ratio square_n), the rest of the data only noise. The noise follows from the ratio in closed
    form; its variance is at least 1, that of the expected errors.
    """
    beyond = total
    for n in range(energy.size):
        beyond -= energy[n]
    beyond = max(beyond, 0.0)
    decade, most_probable = 0.0, 0.0
    for tried in (_PRIOR_DECADES, _BETWEEN_DECADES):
        around, best = decade, -np.inf
        for between in tried:
            evidence, noise = _evidence(10.0 ** (around + between), square, energy, beyond, count)
            if evidence > best:
                best, decade, most_probable = evidence, around + between, noise
    return 10.0**decade, most_probable


@compiled
def _evidence(ratio: float, square: Floats, energy: Floats, beyond: float, count: int) -> tuple[float, float]:
    """Log evidence of one ratio, up to a constant, and the most probable noise variance."""
    total, evidence = beyond, 0.0
    for first in range(0, square.size, _FACTORS):
        squares, energies, product = square[first : first + _FACTORS], energy[first : first + _FACTORS], 1.0
        for n in range(squares.size):
            spread = 1.0 + ratio * squares[n]
            total += energies[n] / spread
            product *= spread
        evidence -= np.log(product) / 2
    noise = max(total / count, 1.0)
    return evidence - (count * np.log(noise) + total / noise) / 2, noise
