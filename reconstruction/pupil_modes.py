"""Functions of the pupil position in which a wavefront is written: phi(u) = sum_p e_p R_p(u)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from reconstruction.displacement import Mask
from reconstruction.geometry import Floats, Sensor, centered_steps
from reconstruction.polynomials import legendre, legendre_lenslet_gradients
from reconstruction.zernike import zernike, zernike_lenslet_gradients

PupilBasis = Literal["legendre", "zernike"]


@dataclass(frozen=True, slots=True, eq=False)
class PupilModes:
    """The modes R_p on the lenslets of a sensor, piston first."""

    values: Floats  # at the lenslet centres, (pupil_mode, lenslet_row, lenslet_column)
    gradients: Floats  # mean over each lenslet, 1/m, (pupil_mode, lenslet_row, lenslet_column, xy)
    inside: Mask  # the lenslets that the pupil covers, (lenslet_row, lenslet_column)


def pupil_modes(sensor: Sensor, basis: PupilBasis, count: int) -> PupilModes:
    """The first `count` modes: Legendre over the whole lattice, or Zernike over the circle inscribed in it.

    A lenslet belongs to the circle if its centre does; its gradients are means over the whole lenslet.
    """
    rows, columns = sensor.lenslet_rows, sensor.lenslet_columns
    half_x_m, half_y_m = sensor.pupil_half_width_m
    if basis == "legendre":
        return PupilModes(
            values=legendre(count, sensor.pupil_x_m / half_x_m, sensor.pupil_y_m[:, None] / half_y_m),
            gradients=legendre_lenslet_gradients(count, rows, columns) / sensor.pupil_half_width_m,
            inside=np.ones((rows, columns), np.bool_),
        )
    radius_m = min(half_x_m, half_y_m)
    x, y = sensor.pupil_x_m / radius_m, sensor.pupil_y_m[:, None] / radius_m
    edges_x, edges_y = (
        centered_steps(lenslets + 1) * sensor.lenslet_pitch_m / radius_m for lenslets in (columns, rows)
    )
    return PupilModes(
        values=zernike(count, x, y),
        gradients=zernike_lenslet_gradients(count, edges_x, edges_y) / radius_m,
        inside=np.asarray(x**2 + y**2 <= 1),
    )
