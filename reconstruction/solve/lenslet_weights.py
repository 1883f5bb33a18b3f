"""How much each lenslet counts in a wavefront: as its reference lets expect, less where a frame shows less."""

from __future__ import annotations

import numpy as np

from reconstruction.arrays import Floats
from reconstruction.runtime.compilation import compiled
from reconstruction.solve.whitening import SYSTEMATIC_PX

_STEP = np.log(4.0)  # of weights: so what they determine need not be computed anew for every frame


@compiled
def mean_variance(covariance: Floats) -> Floats:
    """Variance of each lenslet's displacement, mean over its coefficients, px^2, (L,).

    `covariance` (L, Q, xy, Q, xy), px^2. What is systematic is part of it: a method may find no noise at all, of the
    reference against itself.
    """
    lenslets, modes = covariance.shape[:2]
    variance = np.zeros(lenslets)
    for lenslet in range(lenslets):
        for q in range(modes):
            variance[lenslet] += covariance[lenslet, q, 0, q, 0] + covariance[lenslet, q, 1, q, 1]
        variance[lenslet] = variance[lenslet] / (2 * modes) + SYSTEMATIC_PX**2
    return variance


@compiled
def lenslet_weights(variance: Floats, expected: Floats, usual: float) -> Floats:
    """Weights (L,) for the `variance` (L,) that a frame's displacements have; where it is NaN, none.

    `expected` (L,) is that of the reference, `usual` the median of it. A weight is usual / expected, and less in steps
    of four where the frame's variance, over that of most lenslets, is more than that.
    """
    ratio = variance / expected
    known = np.isfinite(ratio)
    weights = np.zeros(ratio.size)
    if known.any():
        most = np.median(ratio[known])
        for lenslet in range(ratio.size):
            if known[lenslet]:
                steps = np.rint(np.log(ratio[lenslet] / most) / _STEP)
                weights[lenslet] = usual / expected[lenslet] * 4.0 ** -max(steps, 0.0)
    return weights
