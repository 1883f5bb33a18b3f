"""Removal of piston, tilt and defocus from wavefronts."""

import numpy as np

from reconstruction.arrays import Floats
from reconstruction.geometry import Arrangement, lenslet_centers
from reconstruction.wavefront import without_piston


def without_tilt(phase: Floats, arrangement: Arrangement = "square") -> Floats:
    """Subtract the best-fitting plane from wavefronts (..., lenslet_row, lenslet_column), ignoring NaN."""
    return without_low_orders(phase, tilt=True, defocus=False, arrangement=arrangement)


def without_low_orders(phase: Floats, *, tilt: bool, defocus: bool, arrangement: Arrangement = "square") -> Floats:
    """Subtract piston and, where asked, tilt and defocus, ignoring NaN.

    Defocus is the paraboloid u^2 + v^2 about the middle of the lattice; it is fitted together with the tilt, whether
    that is subtracted or not.

    Parameters
    ----------
    phase : (..., lenslet_row, lenslet_column)
        rad; NaN where unknown.
    tilt, defocus : bool
        Whether to subtract them.
    arrangement : Arrangement
        Of the lenslets.
    """
    if not (tilt or defocus):
        return without_piston(phase)
    u, v = np.moveaxis(lenslet_centers(arrangement, *phase.shape[-2:]), -1, 0)
    terms = np.stack([np.ones_like(u), u, v, *([u**2 + v**2] * defocus)])
    terms /= np.sqrt(np.mean(terms**2, axis=(1, 2), keepdims=True))
    known = np.isfinite(phase)
    normal = np.tensordot(known.astype(np.float64), terms[:, None] * terms, axes=((-2, -1), (-2, -1)))
    moments = np.tensordot(np.where(known, phase, 0), terms, axes=((-2, -1), (-2, -1)))
    fitted = (np.linalg.pinv(normal, hermitian=True) @ moments[..., None])[..., 0]
    if not tilt:
        fitted[..., 1:3] = 0
    return without_piston(phase - np.tensordot(fitted, terms, axes=1))
