"""One thin layer, whose rays meet it at s = u + ratio x, as a linear map to displacements and to wavefronts.

The layer's phase is a sum of Legendre polynomials over the part that rays meet, its footprint (docs/layers.md). Behind
each lenslet it is projected on local wavefronts P_m(xi) P_n(eta) times field modes, with a known response
of the registration. Over the lattice it is projected on pupil modes times field modes: phi(u, x) = Phi(u + ratio x).
"""

import numpy as np
from numpy.polynomial import legendre as series
from numpy.typing import NDArray

from reconstruction.arrays import Floats, Mask
from reconstruction.geometry import Field, Sensor
from reconstruction.modes.field_modes import FieldModes
from reconstruction.modes.legendre import legendre_orders, legendre_projection
from reconstruction.modes.pupil_modes import PupilModes, pupil_modes
from reconstruction.solve.expected_errors import ExpectedErrors

_FIELD_NODES = {"square": 12, "circle": 24}  # along each axis; exact on a square


def field_projection(field: Field, field_modes: FieldModes) -> tuple[Floats, Floats]:
    """Nodes along both axes of the field, (node,), and the projection on its modes, (field_mode, node_y, node_x)."""
    nodes, weights = series.leggauss(_FIELD_NODES[field.shape])
    inside = field.contains(nodes, nodes[:, None])
    values = field_modes.values(nodes, nodes[:, None]) * inside
    weighted = values * np.outer(weights, weights)
    gram = np.tensordot(weighted, values, axes=([1, 2], [1, 2]))
    return nodes, np.tensordot(np.linalg.inv(gram), weighted, axes=1)


def layer_orders(degree: int) -> NDArray[np.intp]:
    """Orders (i, j) along x and y of a layer's polynomials up to a degree, without the constant, (k, xy)."""
    return np.array(legendre_orders((degree + 1) * (degree + 2) // 2))[1:]


class LayerDesign:
    """Design matrices of layers for one reference."""

    def __init__(self, sensor: Sensor, field: Field, field_modes: FieldModes, errors: ExpectedErrors) -> None:
        self._sensor, self._field = sensor, field
        response = errors.response  # (L, K, n, m, field_mode)
        self._n, self._m = np.nonzero(np.any(response, axis=(0, 1, 4)))
        chosen = response[:, :, self._n, self._m]
        self._response = np.ascontiguousarray(chosen.reshape(*chosen.shape[:2], -1), np.float32)  # (L, K, n m mode)
        self._highest = response.shape[3] - 1
        self._nodes, self._to_modes = field_projection(field, field_modes)

    def footprint_m(self, ratio: float) -> Floats:
        """Half width (xy,) of the part of a layer that rays meet."""
        return np.asarray(np.array(self._sensor.pupil_half_width_m) + abs(ratio) * self._field.half_width_m)

    def rows(self, ratio: float, degree: int) -> NDArray[np.float32]:
        """Whitened displacements per rad of a layer's polynomials, (L, K, k)."""
        i, j = layer_orders(degree).T
        half_x_m, half_y_m = self.footprint_m(ratio)
        sensor, reach_m = self._sensor, ratio * self._field.half_width_m
        along_y = self._along(sensor.pupil_y_m / half_y_m, half_y_m, reach_m, degree)  # (row, j, n, node)
        of_y = np.ascontiguousarray(along_y.transpose(1, 2, 0, 3)[j])  # (k, n, row, node)
        modes, nodes = self._to_modes.shape[:2]
        rows, columns = sensor.lenslet_rows, sensor.lenslet_columns
        local = np.empty((rows, columns, len(i), len(self._n), modes), np.float32)
        for first, x_m in enumerate(sensor.lenslet_centers_m[:2, :, 0]):  # of even and of odd rows
            along_x = self._along(x_m / half_x_m, half_x_m, reach_m, degree)  # (column, i, m, node)
            half = np.tensordot(along_x, self._to_modes, axes=([3], [2]))  # (column, i, m, field_mode, node_y)
            of_x = half.transpose(1, 2, 4, 3, 0)[i].reshape(len(i), self._highest + 1, nodes, -1)
            for place, (n, m) in enumerate(zip(self._n, self._m, strict=True)):
                found = np.matmul(of_y[:, n, first::2], of_x[:, m])  # (k, row, field_mode column)
                found = found.reshape(len(i), -1, modes, columns)
                local[first::2, :, :, place] = found.transpose(1, 3, 0, 2)
        per_rad = np.swapaxes(local.reshape(rows * columns, len(i), -1), 1, 2)
        return np.asarray(np.matmul(self._response, per_rad))

    def _along(self, center: Floats, half_width_m: float, reach_m: float, degree: int) -> Floats:
        """P_i((c + w xi + r x) / h) = sum_m a_m P_m(xi) at the field's nodes x: (cell, i, m, node).

        `center` (cell,) is in half widths of the footprint.
        """
        nodes, project = legendre_projection(self._highest, degree)
        lenslet = nodes * self._sensor.aperture_width_m / 2 / half_width_m
        at = center[:, None, None] + lenslet[:, None] + self._nodes * reach_m / half_width_m  # (cell, xi, x)
        values = series.legvander(at, degree)  # (cell, xi, x, i)
        return np.asarray(np.einsum("cgxi,gm->cimx", values, project, optimize=True))


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
        nodes, project = legendre_projection(self._highest, self._highest)
        values = series.legvander((nodes[:, None] + ratio * self._nodes) / (1 + abs(ratio)), self._highest)
        return np.asarray(np.einsum("pxi,pm->ixm", values, project, optimize=True))
