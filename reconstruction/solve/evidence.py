"""How strong a prior is, as the data themselves tell: the compiled search for the likeliest."""

from __future__ import annotations

import numpy as np

from reconstruction.arrays import Floats
from reconstruction.runtime.compilation import compiled

# Tried for prior over noise, both as variances: roughly first, then every quarter of a decade about the best.
_PRIOR_DECADES = np.linspace(-4.0, 14.0, 19)
_BETWEEN_DECADES = np.linspace(-0.75, 0.75, 7)
_AT_ONCE = 16  # factors of up to 1e15 whose product a number still holds: so one logarithm is enough for all of them
_LEAST = np.finfo(np.float64).tiny


@compiled
def maximize_evidence(square: Floats, along: Floats, total: Floats, count: int) -> Floats:
    """The likeliest ratio of prior to noise variance of each combination, and the noise variance: (2, combination).

    `square` (combination, p) are the singular values' squares, one at most; `along` (combination, p) the `count` data
    along the singular vectors, `total` (combination,) their sums of squares. Under the prior, component p has the
    variance noise (1 + ratio square_p), all others only noise; for a given ratio the likeliest noise follows in closed
    form, so that only the ratio is searched for.
    """
    found = np.zeros((2, total.size))
    for k in range(total.size):
        energy = along[k] ** 2
        beyond = max(total[k] - np.sum(energy), 0.0)
        decade = 0.0
        for tried in (_PRIOR_DECADES, _BETWEEN_DECADES):
            around, best = decade, -np.inf
            for between in tried:
                evidence, noise = _evidence(10.0 ** (around + between), square[k], energy, beyond, count)
                if evidence > best:
                    best, decade, found[1, k] = evidence, around + between, noise
        found[0, k] = 10.0**decade
    return found


@compiled
def _evidence(ratio: float, square: Floats, energy: Floats, beyond: float, count: int) -> tuple[float, float]:
    """Logarithm of the evidence for one ratio, but for a constant, and the likeliest noise variance."""
    spread = 1.0 + ratio * square
    noise = max((np.sum(energy / spread) + beyond) / count, _LEAST)
    evidence = -count / 2 * np.log(noise)
    for first in range(0, spread.size, _AT_ONCE):
        evidence -= np.log(np.prod(spread[first : first + _AT_ONCE])) / 2
    return evidence, noise
