"""Weights of lenslets that are noisier in a frame than in the reference."""

import numpy as np

from reconstruction.arrays import Floats
from reconstruction.runtime.compilation import compiled

_STEP = np.log(4.0)  # of weights, in powers of 4, so that factorisations can be reused from frame to frame


@compiled
def relative_weights(variance: Floats, expected: Floats) -> Floats:
    """Weights (L,) of a frame's lenslets relative to those of the reference: 1, or less for noisier ones.

    `variance` (L,) of the frame's displacements, px^2 (NaN: weight 0), `expected` (L,) of the reference. The weight is
    divided by 4 for each factor of 4 by which the variance, relative to that of most lenslets, exceeds it.
    """
    ratio = variance / expected
    known = np.isfinite(ratio)
    weights = np.zeros(ratio.size)
    if known.any():
        most = np.median(ratio[known])
        for lenslet in range(ratio.size):
            if known[lenslet]:
                weights[lenslet] = 4.0 ** -max(np.rint(np.log(ratio[lenslet] / most) / _STEP), 0.0)
    return weights
