"""Weights of lenslets and of field modes, from the covariance of the displacements.

Errors of field modes that a lenslet cannot distinguish are correlated: in a uniform square only the edges tell x and 1
from P_2(x). A separate fit of each field mode would waste that. In the combinations b = B c with covariance 1 along x
and a diagonal one along y, the fits are independent and optimal.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigh

from reconstruction.arrays import Floats
from reconstruction.displacement import SYSTEMATIC_PX
from reconstruction.runtime.compilation import compiled

_STEP = np.log(4.0)  # of weights, in powers of 4, so that factorisations can be reused from frame to frame


@dataclass(frozen=True, slots=True, eq=False)
class Whitening:
    """The combinations b_k = sum_q B_kq c_q of field modes, whose errors are independent."""

    forward: Floats  # B, (combination, field_mode)
    back: Floats  # its inverse, (field_mode, combination)
    weights: Floats  # 1 / variance of each combination along x and y, (combination, xy)


def no_whitening(field_modes: int) -> Whitening:
    """Each field mode by itself, x and y alike."""
    return Whitening(np.eye(field_modes), np.eye(field_modes), np.ones((field_modes, 2)))


def whitening(covariance: Floats) -> Whitening:
    """Find the combinations of field modes with independent errors.

    `covariance` (lenslet..., field_mode, xy, field_mode, xy), px^2, NaN where lost, is averaged over the lenslets.
    Correlations between x and y are ignored; a symmetric source has none.
    """
    modes = covariance.shape[-2]
    flat = covariance.reshape(-1, modes, 2, modes, 2)
    known = np.isfinite(flat).all(axis=(1, 2, 3, 4))
    if not known.any():
        return no_whitening(modes)
    mean = np.mean(flat[known], axis=0)
    along_x, along_y = (mean[:, axis, :, axis] + SYSTEMATIC_PX**2 * np.eye(modes) for axis in (0, 1))
    along_y, vectors = eigh(along_y, along_x)
    forward = vectors.T
    return Whitening(forward, np.linalg.inv(forward), np.stack([np.ones(modes), 1 / along_y], axis=-1))


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
