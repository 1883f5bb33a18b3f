"""Wavefronts of a hexagonal lattice on the rectangular grid of its rows."""

from functools import lru_cache

import numpy as np
from scipy.interpolate import make_interp_spline

from reconstruction.arrays import Floats
from reconstruction.geometry import Arrangement, lenslet_centers

_CUBIC = 3


def aligned(phase: Floats, arrangement: Arrangement) -> Floats:
    """Move each row of wavefronts (..., lenslet_row, lenslet_column) by a quarter of a pitch: columns become straight.

    A cubic spline interpolates along each row. Lenslets stay unknown (NaN); a square lattice is returned as it is.
    """
    if arrangement == "square":
        return phase
    known = np.isfinite(phase)
    some = known.reshape(-1, *phase.shape[-2:]).any(axis=0)
    matrices = _alignment(some.tobytes(), *some.shape, arrangement)
    found = np.einsum("rij,...rj->...ri", matrices, np.where(known, phase, 0.0))
    return np.where(known, found, np.nan)


@lru_cache(maxsize=16)
def _alignment(known_bytes: bytes, rows: int, columns: int, arrangement: Arrangement) -> Floats:
    """Interpolation of each row from its known lenslets, (lenslet_row, column, lenslet_column)."""
    known = np.frombuffer(known_bytes, np.bool_).reshape(rows, columns)
    x = lenslet_centers(arrangement, rows, columns)[..., 0]
    matrices, unit = np.zeros((rows, columns, columns)), np.eye(columns)
    for row, is_known in enumerate(known):
        count = int(np.count_nonzero(is_known))
        if count:
            spline = make_interp_spline(x[row, is_known], unit[is_known], k=min(count - 1, _CUBIC))
            matrices[row] = spline(x[:2].mean(axis=0))
    return matrices
