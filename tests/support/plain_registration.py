"""Reference registration in plain NumPy and SciPy, to compare the fast one with.

The residual gain I1(x + d) + offset - I0 is made orthogonal to the steepest-descent images T_q dI0/dx, T_q dI0/dy, I0
and 1, all pixels weighted alike, by Gauss-Newton steps from zero. In real light I0 x and I0 y are among the images,
too, but nothing is made of their steps. In the paper's world, which conserves flux, the displaced light is multiplied
by det(1 + dd/dx), and the images are d(I0 T_q)/dx and d(I0 T_q)/dy.
"""

from __future__ import annotations

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray
from scipy import ndimage

from reconstruction.arrays import Floats
from reconstruction.geometry import Field, Lattice, Sensor

_ORDERS = [(degree - n, n) for degree in range(5) for n in range(degree + 1)]  # degrees along x, along y
_STEP_PX = 1e-3  # of numerical derivatives
_STEPS = 40


def plain_registration(
    reference: NDArray[np.float32],
    frame: NDArray[np.float32],
    *,
    sensor: Sensor,
    lattice: Lattice,
    field: Field,
    field_modes: int,
    offset_px: Floats,
    rotation: bool = True,
) -> Floats:
    """Coefficients c_q, px, (lenslet_row, lenslet_column, field_mode, xy); without `rotation`, of a gradient.

    From the pixels at `offset_px` (pixel, xy) from each lenslet's centre, along the lattice.
    """
    half_width_px = field.half_width_px(sensor)
    x, y = offset_px.T
    conserve_flux = int(field.neglect_propagation)
    cosine, sine = np.cos(lattice.rotation_rad), np.sin(lattice.rotation_rad)
    orders = _ORDERS[:field_modes]

    def modes(x: Floats, y: Floats) -> Floats:
        along_x = legendre.legvander(x / half_width_px, 4)
        along_y = legendre.legvander(y / half_width_px, 4)
        return np.stack([along_x[:, m] * along_y[:, n] for m, n in orders])

    def by_x(function: object) -> Floats:
        assert callable(function)
        return np.asarray((function(x + _STEP_PX, y) - function(x - _STEP_PX, y)) / (2 * _STEP_PX))

    def by_y(function: object) -> Floats:
        assert callable(function)
        return np.asarray((function(x, y + _STEP_PX) - function(x, y - _STEP_PX)) / (2 * _STEP_PX))

    splines = [ndimage.spline_filter(image.astype(float), order=3, mode="mirror") for image in (reference, frame)]
    mode_values, mode_by_x, mode_by_y = modes(x, y), by_x(modes), by_y(modes)
    basis = np.eye(2 * field_modes)
    if not rotation:
        powers = [(m - n, n) for m in range(1, orders[-1][1] + 2) for n in range(m + 1)]
        potentials = (lambda x, y, m=m, n=n: (x / half_width_px) ** m * (y / half_width_px) ** n for m, n in powers)
        gradients = [np.concatenate([by_x(potential), by_y(potential)]) for potential in potentials]
        displacements = np.kron(np.eye(2), mode_values)
        basis = np.linalg.lstsq(displacements.T, np.transpose(gradients))[0].T
        basis = np.linalg.qr(basis.T)[0].T
    found = np.zeros((sensor.lenslet_rows, sensor.lenslet_columns, field_modes, 2))
    centers = lattice.lenslet_centers_px(sensor.lenslet_rows, sensor.lenslet_columns)
    for row, column in np.ndindex(found.shape[:2]):
        center_x, center_y = centers[row, column]

        def look(spline: Floats, x: Floats, y: Floats, cx: float = center_x, cy: float = center_y) -> Floats:
            where = [cy + sine * x + cosine * y, cx + cosine * x - sine * y]
            return np.asarray(ndimage.map_coordinates(spline, where, order=3, mode="mirror", prefilter=False))

        def carried(x: Floats, y: Floats, look: object = look) -> Floats:
            assert callable(look)
            return np.asarray(look(splines[0], x, y) * modes(x, y))

        light = look(splines[0], x, y)
        spread = light * np.concatenate([mode_by_x, mode_by_y])
        changes = np.concatenate([by_x(carried), by_y(carried)]) - (1 - conserve_flux) * spread
        descent = np.concatenate([basis @ changes, [light, np.ones_like(light)]])
        brightness = (1 - conserve_flux) * light * [x / half_width_px, y / half_width_px]
        every = np.concatenate([descent, brightness])
        inverse = (np.linalg.pinv(every @ every.T, rcond=1e-12, hermitian=True) @ every)[: len(descent)]
        c, gain, offset = np.zeros((field_modes, 2)), 1.0, 0.0
        for _ in range(_STEPS):
            d = c.T @ mode_values
            (xu, yu), (xv, yv) = c.T @ mode_by_x, c.T @ mode_by_y
            stretch = 1 + conserve_flux * ((1 + xu) * (1 + yv) - xv * yu - 1)
            residual = (gain * look(splines[1], x + d[0], y + d[1]) + offset) * stretch - light
            step = inverse @ residual
            c = c - (step[:-2] @ basis).reshape(2, field_modes).T
            gain, offset = gain * (1 - step[-2]), offset * (1 - step[-2]) - step[-1]
            if np.abs(step[:-2]).max() < 1e-6:
                break
        found[row, column] = c
    return found
