"""Displacements caused by the phase of one thin layer, whose rays meet it at s = u + ratio x (docs/layers.md).

The phase is a sum of Legendre polynomials over the part of the layer that rays meet, its footprint. Behind each lenslet
it is projected on local wavefronts P_m(xi) P_n(eta) times field modes, to which the registration's response is known.
"""

import numpy as np
from numpy.polynomial import legendre as series
from numpy.typing import NDArray

from reconstruction.arrays import Floats
from reconstruction.geometry import Field, Sensor
from reconstruction.modes.field_modes import FieldModes
from reconstruction.modes.legendre import legendre_orders
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
        nodes, weights = series.leggauss((degree + self._highest) // 2 + 1)
        lenslet = nodes * self._sensor.aperture_width_m / 2 / half_width_m
        at = center[:, None, None] + lenslet[:, None] + self._nodes * reach_m / half_width_m  # (cell, xi, x)
        project = series.legvander(nodes, self._highest) * weights[:, None] * (np.arange(self._highest + 1) + 0.5)
        values = series.legvander(at, degree)  # (cell, xi, x, i)
        return np.asarray(np.einsum("cgxi,gm->cimx", values, project, optimize=True))
