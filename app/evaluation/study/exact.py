"""Wavefront from the true slopes of the screen, in the field modes of a warp.

Its residual shows what the field and pupil modes cannot represent; any excess of an estimator over it comes from
registration.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from reconstruction.arrays import Floats
from reconstruction.displacement import Displacement
from reconstruction.pipeline import Reconstructor
from reconstruction.wavefront import Wavefront
from simulated_devices.sample import Sample

_FIELD_NODES, _LENSLET_NODES = 7, 6  # of Gauss-Legendre quadrature along each axis


def exact_wavefront(sample: Sample, reconstructor: Reconstructor, displacement: Displacement) -> Wavefront:
    """Solve for the true displacements of the frame that was registered as `displacement`."""
    nodes, weights = np.polynomial.legendre.leggauss(_FIELD_NODES)
    modes = displacement.modes.values(nodes, nodes[:, None])  # (field_mode, node_y, node_x)
    square = np.einsum("qyx,qyx,y,x->q", modes, modes, weights, weights)
    half_width_m = reconstructor.field.half_width_m
    coefficients = np.zeros_like(displacement.coefficients)
    for row, y in enumerate(nodes):
        for column, x in enumerate(nodes):
            slopes = _mean_slopes(sample, reconstructor, x * half_width_m, y * half_width_m)
            share = modes[:, row, column] * weights[row] * weights[column] / square
            coefficients += share[:, None] * slopes[:, :, None]
    return reconstructor.solve(replace(displacement, coefficients=coefficients / reconstructor.sensor.slope_per_px))


def _mean_slopes(sample: Sample, reconstructor: Reconstructor, x_m: float, y_m: float) -> Floats:
    """Mean slope over each lenslet for the object point (x, y): (lenslet_row, lenslet_column, xy), rad/m."""
    sensor, rays = reconstructor.sensor, sample.ray_map
    half_m = sensor.lenslet_pitch_m / 2
    nodes, weights = np.polynomial.legendre.leggauss(_LENSLET_NODES)
    along_m, across_m = np.array([-half_m, half_m]), nodes * half_m

    def at(u_m: Floats, v_m: Floats) -> Floats:
        """Phase at pupil positions u, v from each lenslet's centre: (u, v, lenslet_row, lenslet_column)."""
        s_m = rays.pupil_scale * (sensor.pupil_x_m + u_m[:, None, None, None]) + rays.field_scale * x_m
        t_m = rays.pupil_scale * (sensor.pupil_y_m[:, None] + v_m[None, :, None, None]) + rays.field_scale * y_m
        return sample.screen.at(s_m, t_m)

    x_slopes = np.tensordot(weights / 2, np.diff(at(along_m, across_m), axis=0)[0], axes=1)
    y_slopes = np.tensordot(weights / 2, np.diff(at(across_m, along_m), axis=1)[:, 0], axes=1)
    return np.stack([x_slopes, y_slopes], axis=-1) / sensor.lenslet_pitch_m
