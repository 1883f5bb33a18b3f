"""Zonal reconstruction by Southwell's equations (J. Opt. Soc. Am. 70, 998, 1980).

Between neighbouring lenslets, four or six, the wavefront rises by the mean of their slopes along the way times the
pitch. The weighted least-squares solution over all pairs of valid lenslets needs one sparse factorisation, cached until
the valid lenslets or their weights change.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import SuperLU, splu

from reconstruction.arrays import Booleans, Floats
from reconstruction.displacement import Displacement
from reconstruction.geometry import Arrangement, Sensor, lenslet_centers


@dataclass(frozen=True, slots=True, eq=False)
class ZonalSolution:
    """Displacements, the slopes of the wavefront, that are integrated on request."""

    sensor: Sensor
    displacement: Displacement
    weights: Floats | None = None  # in any unit, (lenslet_row, lenslet_column)

    def wavefront(self, field_modes: Floats) -> Floats:
        """Wavefront, rad, for values (..., field_mode) of the field modes; see `ModalSolution`."""
        displacement, sensor = self.displacement, self.sensor
        return zonal_wavefront(
            np.tensordot(field_modes, displacement.coefficients * sensor.slope_per_px, axes=([-1], [2])),
            displacement.valid,
            pitch_m=sensor.lenslet_pitch_m,
            weights=self.weights,
            arrangement=sensor.arrangement,
        )

    def sigma(self, field_modes: Floats) -> Floats:
        """Standard deviation of `wavefront` from the noise of the slopes, rad, the same shape."""
        valid, sensor = self.displacement.valid, self.sensor
        sigma = np.full((*field_modes.shape[:-1], valid.size), np.nan)
        equations = _equations(valid, self.weights, sensor.arrangement)
        if equations is not None:
            rad_per_px = sensor.slope_per_px * sensor.lenslet_pitch_m
            by_px = [equations.solve(np.eye(valid.size), axis) * rad_per_px for axis in (0, 1)]  # each (node, lenslet)
            covariance = self.displacement.covariance
            noise = np.where(valid[..., None, None, None, None], covariance, 0.0).reshape(-1, *covariance.shape[2:])
            at_view = np.einsum("...q,lqarb,...r->...lab", field_modes, noise, field_modes, optimize=True)
            variance = sum(at_view[..., a, b] @ (by_px[a] * by_px[b]).T for a, b in ((0, 0), (0, 1), (1, 0), (1, 1)))
            sigma[..., equations.node] = np.sqrt(variance)
        return sigma.reshape(*field_modes.shape[:-1], *valid.shape)


@dataclass(frozen=True, slots=True, eq=False)
class _Southwell:
    """Factorised equations of one connected set of lenslets (nodes)."""

    node: NDArray[np.intp]  # flat index of every lenslet with an equation, (node,)
    rise: tuple[sparse.csr_array, sparse.csr_array]  # between pairs, by x slopes, by y slopes: (pair, lenslet)
    weighted: sparse.csr_array  # difference^T weight, (node - 1, pair)
    factors: SuperLU  # of difference^T weight difference; the first node is held at zero

    def solve(self, slopes: Floats, axis: int) -> Floats:
        """Wavefronts without piston (node, case), per pitch, of slopes (lenslet, case) along one axis."""
        phase = self.factors.solve(np.asarray(self.weighted @ (self.rise[axis] @ slopes)))
        phase = np.concatenate([np.zeros((1, slopes.shape[1])), phase])
        return np.asarray(phase - phase.mean(axis=0))


def zonal_wavefront(
    slopes: Floats, valid: Booleans, *, pitch_m: float, weights: Floats | None = None, arrangement: Arrangement
) -> Floats:
    """Integrate slopes to wavefronts without piston, all leading axes at once.

    From rad/m, (..., lenslet_row, lenslet_column, xy), to rad, (..., lenslet_row, lenslet_column); NaN outside the
    largest connected set of lenslets that are `valid`, (lenslet_row, lenslet_column). Their weights are in any unit.
    """
    flat = np.where(valid[..., None], slopes, 0.0).reshape(-1, valid.size, 2)
    wavefront = np.full((len(flat), valid.size), np.nan)
    equations = _equations(valid, weights, arrangement)
    if equations is not None:
        phase = sum(equations.solve(flat[..., axis].T, axis) for axis in (0, 1))
        wavefront[:, equations.node] = np.transpose(phase) * pitch_m
    return wavefront.reshape(*slopes.shape[:-3], *valid.shape)


def _equations(valid: Booleans, weights: Floats | None, arrangement: Arrangement) -> _Southwell | None:
    weights = np.ones(valid.shape) if weights is None else np.asarray(weights, np.float64)
    return _southwell(valid.tobytes(), weights.tobytes(), *valid.shape, arrangement)


@lru_cache(maxsize=16)
def _southwell(
    valid_bytes: bytes, weight_bytes: bytes, rows: int, columns: int, arrangement: Arrangement
) -> _Southwell | None:
    """Factorise the equations; None if no two valid lenslets are neighbours."""
    valid = np.frombuffer(valid_bytes, np.bool_)
    weights = np.frombuffer(weight_bytes, np.float64)
    pair = _neighbours(np.arange(rows * columns).reshape(rows, columns), arrangement)
    pair = pair[:, valid[pair].all(axis=0)]
    graph = sparse.coo_array((np.ones(pair.shape[1]), (pair[0], pair[1])), shape=(valid.size, valid.size))
    labels = connected_components(graph, directed=False)[1]
    node = np.flatnonzero(labels == np.argmax(np.bincount(labels)))
    if node.size < 2:
        return None
    pair = pair[:, np.isin(pair[0], node)]
    ones = np.ones(pair.shape[1])
    centers = lenslet_centers(arrangement, rows, columns).reshape(-1, 2)
    half_way = (centers[pair[1]] - centers[pair[0]]).T / 2  # (xy, pair)
    rise_x, rise_y = (_pairwise(pair, (along, along), valid.size) for along in half_way)
    difference = _pairwise(pair, (-ones, ones), valid.size)[:, node[1:]]
    weighted = (difference.T @ sparse.diags_array(1 / np.sum(1 / weights[pair], axis=0))).tocsr()
    return _Southwell(node, (rise_x, rise_y), weighted, splu((weighted @ difference).tocsc()))


def _neighbours(index: NDArray[np.intp], arrangement: Arrangement) -> NDArray[np.intp]:
    """Pairs (2, pair) of the indices of neighbours in a lattice of indices (lenslet_row, lenslet_column)."""
    pairs = [(index[:, :-1], index[:, 1:]), (index[:-1], index[1:])]
    if arrangement == "hexagonal":  # the second neighbour in the next row: left of even rows, right of odd ones
        pairs += [(index[:-1:2, 1:], index[1::2, :-1]), (index[1:-1:2, :-1], index[2::2, 1:])]
    return np.concatenate([np.stack([one.ravel(), other.ravel()]) for one, other in pairs], axis=1)


def _pairwise(pair: NDArray[np.intp], weights: tuple[Floats, Floats], lenslets: int) -> sparse.csr_array:
    """Sparse operator from lenslets to pairs (2, pair), with weights (pair,) of first and second one."""
    row, values = np.tile(np.arange(pair.shape[1]), 2), np.concatenate(weights)
    some = values != 0
    return sparse.csr_array((values[some], (row[some], pair.ravel()[some])), shape=(pair.shape[1], lenslets))
