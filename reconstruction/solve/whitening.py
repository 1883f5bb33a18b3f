"""Combinations of the field modes whose errors are independent of one another.

What a lenslet says of one field mode it cannot tell from another is wrong in both: in a uniform square only the edges
show x and 1 apart from P_2(x). A registration's errors therefore hang together, and a fit to each field mode
alone would waste what they have in common. In combinations b = B c for which the errors along x have the covariance
1, and those along y a diagonal one, each combination is a problem of its own again, and none is lost.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigh

from reconstruction.arrays import Floats

# What registration gets wrong without any noise on the screens of docs/estimator.md, in each coefficient; nothing is
# known of how these errors hang together.
SYSTEMATIC_PX = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class Whitening:
    """The combinations b_k = sum_q B_kq c_q of the coefficients of the field modes."""

    forward: Floats  # B, (combination, field_mode)
    back: Floats  # its inverse, (field_mode, combination)
    weights: Floats  # 1 / variance of each combination along x and y, (combination, xy)


def no_whitening(field_modes: int) -> Whitening:
    """Each field mode for itself, x and y alike."""
    return Whitening(np.eye(field_modes), np.eye(field_modes), np.ones((field_modes, 2)))


def whitening(covariance: Floats) -> Whitening:
    """Find the combinations for noise with the `covariance` (lenslet..., field_mode, xy, field_mode, xy), px^2.

    It is the mean over all lenslets that counts; NaN stands for a lost one. What an error along x has to do with
    one along y is left aside: in a source that is symmetric, nothing.
    """
    modes = covariance.shape[-2]
    flat = covariance.reshape(-1, modes, 2, modes, 2)
    told = np.isfinite(flat).all(axis=(1, 2, 3, 4))
    if not told.any():
        return no_whitening(modes)
    mean = np.mean(flat[told], axis=0)
    along_x, along_y = (mean[:, axis, :, axis] + SYSTEMATIC_PX**2 * np.eye(modes) for axis in (0, 1))
    along_y, vectors = eigh(along_y, along_x)
    forward = vectors.T
    return Whitening(forward, np.linalg.inv(forward), np.stack([np.ones(modes), 1 / along_y], axis=-1))
