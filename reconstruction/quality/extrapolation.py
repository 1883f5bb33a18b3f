"""Extrapolation of wavefronts into lost lenslets and one lenslet beyond the lattice."""

from dataclasses import dataclass
from functools import lru_cache, reduce

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import SuperLU, splu

from reconstruction.arrays import Floats, Mask

_THIRD = ((1.0, "xxx"), (3.0, "xxy"), (3.0, "xyy"), (1.0, "yyy"))  # weight and directions of the third differences
_STIFFNESS = 1e-7  # of first differences, which decide where too few lenslets are known for a curvature


@dataclass(frozen=True, slots=True, eq=False)
class _ExtrapolationMatrix:
    """Least squares of all differences for one set of known lenslets, factorised."""

    factors: SuperLU  # of the unknown lenslets, (unknown, unknown)
    coupling: sparse.csr_array  # (unknown, known)


def extrapolate(phase: Floats) -> Floats:
    """Extrapolate wavefronts (..., lenslet_row, lenslet_column), rad, by one lenslet on every side: all finite.

    Known values stay; the others minimise third differences, so that second-degree polynomials continue exactly. A
    wavefront without any known value becomes zero.
    """
    padded = np.pad(phase, [(0, 0)] * (phase.ndim - 2) + [(1, 1), (1, 1)], constant_values=np.nan)
    flat = padded.reshape(-1, *padded.shape[-2:])
    for wavefront in flat:
        known = np.isfinite(wavefront)
        if known.any():
            equations = _equations(known.tobytes(), *wavefront.shape)
            wavefront[~known] = equations.factors.solve(-(equations.coupling @ wavefront[known]))
        else:
            wavefront[:] = 0
    return flat.reshape(padded.shape)


@lru_cache(maxsize=16)
def _equations(known_bytes: bytes, rows: int, columns: int) -> _ExtrapolationMatrix:
    known: Mask = np.frombuffer(known_bytes, np.bool_)
    energy = sum(
        (weight * _energy(directions, rows, columns) for weight, directions in _THIRD),
        start=_STIFFNESS * (_energy("x", rows, columns) + _energy("y", rows, columns)),
    )
    of_unknown = sparse.csr_array(energy)[np.flatnonzero(~known)]
    return _ExtrapolationMatrix(
        factors=splu(of_unknown[:, np.flatnonzero(~known)].tocsc()),
        coupling=of_unknown[:, np.flatnonzero(known)].tocsr(),
    )


def _energy(directions: str, rows: int, columns: int) -> sparse.csr_array:
    """Sum of the squares of all differences along `directions`, as a quadratic form: (lenslet, lenslet)."""
    along_y = _differences(rows, directions.count("y"))
    along_x = _differences(columns, directions.count("x"))
    differences = sparse.kron(along_y, along_x, format="csr")
    return sparse.csr_array(differences.T @ differences)


def _differences(count: int, order: int) -> sparse.csr_array:
    """Matrix of the differences of that order between `count` neighbours: (count - order, count)."""
    identity: NDArray[np.float64] = np.eye(count)
    return sparse.csr_array(reduce(lambda matrix, _: np.diff(matrix, axis=0), range(order), identity))
