"""Wavefronts of one thin layer, in pupil modes times field modes.

The ray from the field position x through the pupil position u meets the layer at s = u + ratio x, up to a factor, so
that phi(u, x) = Phi(u + ratio x) (docs/layers.md). Phi is a sum of Legendre polynomials over the part of the layer that
rays meet, its footprint.
"""

import numpy as np
from numpy.polynomial import legendre as series

from reconstruction.arrays import Floats, Mask
from reconstruction.geometry import Field
from reconstruction.modes.field_modes import FieldModes
from reconstruction.modes.legendre import legendre_orders

_NODES = 24  # along each axis of the field: exact on a square


class LayerModes:
    """Projection of a layer's polynomials up to some degree on pupil modes times field modes; one ratio per call.

    Both are Legendre polynomials P_i(x) P_j(y) without the constant, ordered as `legendre_orders`.
    """

    def __init__(self, degree: int, field: Field, field_modes: FieldModes) -> None:
        self.orders = np.array(legendre_orders((degree + 1) * (degree + 2) // 2))[1:]  # (k, xy)
        self.degree = self.orders.sum(axis=1)  # (k,)
        self._highest = degree
        self._nodes, weights = series.leggauss(_NODES)
        inside = field.contains(self._nodes, self._nodes[:, None])
        values = field_modes.values(self._nodes, self._nodes[:, None]) * inside  # (field_mode, y, x)
        weighted = values * np.outer(weights, weights)
        gram = np.tensordot(weighted, values, axes=([1, 2], [1, 2]))
        self._to_modes = np.tensordot(np.linalg.inv(gram), weighted, axes=1)  # (field_mode, y, x)
        # A layer's polynomial of degree k has no product of a higher degree in pupil and field together.
        self.columns: Mask = self.degree[:, None] + field_modes.degree <= degree  # (pupil_mode - 1, field_mode)

    def __call__(self, ratio: Floats) -> Floats:
        """Coefficients of every polynomial at `columns`, (column, k).

        `ratio` (xy,) is the field's share of the footprint over the pupil's: ratio times the half width of the field
        over that of the lattice.
        """
        along_x, along_y = (self._along(float(of_axis)) for of_axis in ratio)
        half = np.tensordot(self._to_modes, along_x, axes=([2], [1]))  # (field_mode, y, i, m)
        full = np.einsum("qyim,jyn->ijnmq", half, along_y, optimize=True)
        i, j = self.orders.T
        products = full[i, j][:, j, i]  # (k, pupil_mode - 1, field_mode)
        return np.ascontiguousarray(products[:, self.columns].T)

    def _along(self, ratio: float) -> Floats:
        """P_i((xi + ratio x) / (1 + |ratio|)) = sum_m a_m P_m(xi) at the nodes x: (i, node, m)."""
        nodes, weights = series.leggauss(self._highest + 1)
        values = series.legvander((nodes[:, None] + ratio * self._nodes) / (1 + abs(ratio)), self._highest)
        project = series.legvander(nodes, self._highest) * weights[:, None] * (np.arange(self._highest + 1) + 0.5)
        return np.asarray(np.einsum("pxi,pm->ixm", values, project, optimize=True))
