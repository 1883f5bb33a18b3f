"""Zonal reconstruction: Southwell's equations (J. Opt. Soc. Am. 70, 998, 1980) for the lenslet centres.

Between two neighbouring lenslets a pitch apart the wavefront rises by the mean of their slopes times the pitch. The
least-squares solution over all pairs of valid lenslets is found by one sparse factorisation, which depends on the
set of valid lenslets alone and is kept until that set changes.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import SuperLU, splu

from reconstruction.displacement import Mask
from reconstruction.geometry import Floats


@dataclass(frozen=True, slots=True, eq=False)
class ZonalSolution:
    """Slopes whose wavefront is integrated when it is asked for."""

    slopes: Floats  # of every field mode, rad/m, (lenslet_row, lenslet_column, field_mode, xy)
    valid: Mask  # (lenslet_row, lenslet_column)
    pitch_m: float

    def wavefront(self, field_modes: Floats) -> Floats:
        """Wavefront, rad, where the field modes have the values (..., field_mode); see `wavefront.Solution`."""
        slopes = np.tensordot(field_modes, self.slopes, axes=([-1], [2]))
        return zonal_wavefront(slopes, self.valid, pitch_m=self.pitch_m)


@dataclass(frozen=True, slots=True, eq=False)
class _Southwell:
    """The equations for one set of lenslets, factorised; nodes are the lenslets that hang together."""

    node: NDArray[np.intp]  # flat index of every lenslet with an equation, (node,)
    mean: tuple[sparse.csr_array, sparse.csr_array]  # of x slopes, of y slopes, over their pairs: (pair, lenslet)
    difference: sparse.csr_array  # over all pairs, x pairs first; the first node is held at zero: (pair, node - 1)
    factors: SuperLU  # of difference^T difference


def zonal_wavefront(slopes: Floats, valid: Mask, *, pitch_m: float) -> Floats:
    """Integrate slopes (..., lenslet_row, lenslet_column, xy), rad/m, to wavefronts (..., lenslet_row, lenslet_column).

    The wavefronts are in rad, without piston, all leading axes at once. Only lenslets that hang together with the
    largest connected set of valid ones share its piston; all others are NaN, as is everything without a valid pair.
    """
    flat = np.where(valid[..., None], slopes, 0.0).reshape(-1, valid.size, 2)
    wavefront = np.full((len(flat), valid.size), np.nan)
    equations = _southwell(valid.tobytes(), valid.shape[0], valid.shape[1])
    if equations is not None:
        rise = np.concatenate([mean @ flat[..., axis].T for axis, mean in enumerate(equations.mean)]) * pitch_m
        phase = equations.factors.solve(equations.difference.T @ rise)
        phase = np.concatenate([np.zeros((1, len(flat))), phase])
        wavefront[:, equations.node] = (phase - phase.mean(axis=0)).T
    return wavefront.reshape(*slopes.shape[:-3], *valid.shape)


@lru_cache(maxsize=16)
def _southwell(valid_bytes: bytes, rows: int, columns: int) -> _Southwell | None:
    """Set up and factorise the equations for a set of valid lenslets; None when no two of them are neighbours."""
    valid = np.frombuffer(valid_bytes, np.bool_)
    index = np.arange(rows * columns).reshape(rows, columns)
    pairs = [
        np.stack([index[:, :-1].ravel(), index[:, 1:].ravel()]),
        np.stack([index[:-1].ravel(), index[1:].ravel()]),
    ]
    pairs = [pair[:, valid[pair].all(axis=0)] for pair in pairs]
    both = np.concatenate(pairs, axis=1)
    graph = sparse.coo_array((np.ones(both.shape[1]), (both[0], both[1])), shape=(valid.size, valid.size))
    labels = connected_components(graph, directed=False)[1]
    node = np.flatnonzero(labels == np.argmax(np.bincount(labels)))
    if node.size < 2:
        return None
    pairs = [pair[:, np.isin(pair[0], node)] for pair in pairs]
    half = np.full(2, 0.5)
    mean = tuple(_pairwise(pair, half, valid.size) for pair in pairs)
    difference = _pairwise(np.concatenate(pairs, axis=1), np.array([-1.0, 1.0]), valid.size)[:, node[1:]]
    return _Southwell(node, (mean[0], mean[1]), difference, splu((difference.T @ difference).tocsc()))


def _pairwise(pair: NDArray[np.intp], weights: Floats, lenslets: int) -> sparse.csr_array:
    """Sparse operator from lenslets to pairs (2, pair) with the given weights of first and second."""
    count = pair.shape[1]
    values = np.repeat(weights, count)
    return sparse.csr_array((values, (np.tile(np.arange(count), 2), pair.ravel())), shape=(count, lenslets))
