"""Wavefronts of one thin layer, in pupil modes times field modes.

The ray from the field position x through the pupil position u meets the layer at s = u + ratio x, up to a factor, so
that phi(u, x) = Phi(u + ratio x) (docs/layers.md). Phi is a sum of Legendre polynomials over the part of the layer that
rays meet, its footprint.
"""

import numpy as np
from numpy.polynomial import legendre as series

from reconstruction.arrays import Floats, Mask
from reconstruction.geometry import Field, Sensor
from reconstruction.layers.layer_design import field_projection, layer_orders
from reconstruction.modes.field_modes import FieldModes
from reconstruction.modes.pupil_modes import PupilModes, pupil_modes


class LayerModes:
    """Projection of a layer's polynomials up to some degree on pupil modes times field modes; one ratio per call.

    Both are Legendre polynomials P_i(x) P_j(y) without the constant, ordered as `legendre_orders`.
    """

    def __init__(self, degree: int, sensor: Sensor, field: Field, field_modes: FieldModes) -> None:
        self._orders = layer_orders(degree)  # (k, xy)
        self._highest = degree
        self._share = field.half_width_m / np.array(sensor.pupil_half_width_m)
        self._nodes, self._to_modes = field_projection(field, field_modes)
        self.pupil_modes: PupilModes = pupil_modes(sensor, "legendre", len(self._orders) + 1)
        # A layer's polynomial of degree k has no product of a higher degree in pupil and field together.
        within = self._orders.sum(axis=1)[:, None] + field_modes.degree <= degree
        self.columns: Mask = np.asarray(within)  # (pupil_mode - 1, field_mode)

    def __call__(self, ratio: float) -> Floats:
        """Coefficients of every polynomial at `columns`, rad, (column, k)."""
        along_x, along_y = (self._along(float(of_axis)) for of_axis in ratio * self._share)
        half = np.tensordot(self._to_modes, along_x, axes=([2], [1]))  # (field_mode, y, i, m)
        i, j = self._orders.T
        products = np.empty((len(i), *self.columns.shape))
        for k, (i_k, j_k) in enumerate(self._orders):
            full = np.tensordot(half[:, :, i_k], along_y[j_k], axes=([1], [0]))  # (field_mode, m, n)
            products[k] = full[:, i, j].T
        return np.ascontiguousarray(products[:, self.columns].T)

    def _along(self, ratio: float) -> Floats:
        """P_i((xi + ratio x) / (1 + |ratio|)) = sum_m a_m P_m(xi) at the nodes x: (i, node, m)."""
        nodes, weights = series.leggauss(self._highest + 1)
        values = series.legvander((nodes[:, None] + ratio * self._nodes) / (1 + abs(ratio)), self._highest)
        project = series.legvander(nodes, self._highest) * weights[:, None] * (np.arange(self._highest + 1) + 0.5)
        return np.asarray(np.einsum("pxi,pm->ixm", values, project, optimize=True))
