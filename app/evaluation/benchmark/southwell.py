"""The bare bones of a zonal solve, to compare ours with: Southwell's equations and SciPy's `splu`, factorised once."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from reconstruction.arrays import Floats


def bare_southwell(rows: int, columns: int, pitch_m: float) -> Callable[[Floats], Floats]:
    """Prepare for a lattice without a lost lenslet, all alike.

    Returns a function from slopes (case, lenslet_row, lenslet_column, xy), rad/m, to wavefronts (case, lenslet_row,
    lenslet_column), rad, without piston.
    """

    def steps(count: int) -> tuple[sparse.csr_array, sparse.csr_array]:
        shape = (count - 1, count)
        return (
            sparse.csr_array(sparse.diags_array([-1.0, 1.0], offsets=[0, 1], shape=shape)),
            sparse.csr_array(sparse.diags_array([0.5, 0.5], offsets=[0, 1], shape=shape)),
        )

    (along_x, mean_x), (along_y, mean_y) = steps(columns), steps(rows)
    one_row, one_column = sparse.eye_array(columns), sparse.eye_array(rows)
    difference = sparse.vstack([sparse.kron(one_column, along_x), sparse.kron(along_y, one_row)]).tocsc()[:, 1:]
    average = sparse.block_diag([sparse.kron(one_column, mean_x), sparse.kron(mean_y, one_row)])
    factors = splu((difference.T @ difference).tocsc())
    right = (difference.T @ average * pitch_m).tocsr()

    def solve(slopes: Floats) -> Floats:
        flat = np.moveaxis(slopes, -1, 1).reshape(len(slopes), -1)
        phase = factors.solve(right @ flat.T)
        phase = np.concatenate([np.zeros((1, len(slopes))), phase])
        return np.asarray((phase - phase.mean(axis=0)).T.reshape(len(slopes), rows, columns))

    return solve
