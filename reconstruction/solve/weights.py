"""Weights of lenslets, from the covariance of their displacements."""

import numpy as np

from reconstruction.arrays import Floats
from reconstruction.displacement import SYSTEMATIC_PX
from reconstruction.runtime.compilation import compiled

_STEP = np.log(4.0)  # of weights, in powers of 4, so that factorisations can be reused from frame to frame


@compiled
def mean_variance(covariance: Floats) -> Floats:
    """Variance of each lenslet, px^2, (L,): mean over its coefficients, plus the systematic error.

    `covariance` (L, Q, xy, Q, xy), px^2, may be zero for the reference registered against itself.
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
    """Inverse-variance weights (L,) from the reference, lowered for lenslets that are noisier in a frame.

    `variance` (L,) of the frame's displacements, px^2 (NaN: weight 0), `expected` (L,) of the reference, `usual` its
    median. The weight is usual / expected, divided by 4 for each factor of 4 by which the variance, relative to that of
    most lenslets, exceeds it.
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
