"""Wavefronts in closed form, as the reconstruction would return them."""

from __future__ import annotations

import numpy as np

from reconstruction.arrays import Floats
from reconstruction.modes.field_modes import LegendreModes
from reconstruction.modes.pupil_modes import pupil_modes
from reconstruction.settings import PupilBasis
from reconstruction.solve.expected_errors import MeanGradients
from reconstruction.solve.modal import ModalSolver
from reconstruction.solve.zonal import ZonalSolution
from reconstruction.wavefront import Wavefront
from support.gui_bench import FIELD, SENSOR
from support.optics import converged

U, V = np.meshgrid(SENSOR.pupil_x_m, SENSOR.pupil_y_m)


def bowl(tilt_rad_per_m: float = 0.0) -> Wavefront:
    """Defocus that grows by half from the field centre to its +x edge, plus a tilt along x."""
    slopes = np.stack([2e6 * U + tilt_rad_per_m, 2e6 * V], axis=-1)
    growth = np.stack([1e6 * U, 1e6 * V], axis=-1)
    slopes = np.stack([slopes, growth, np.zeros_like(slopes)], axis=2)
    variance = np.full(slopes.shape, 100.0**2)
    displacement = converged(LegendreModes(3), slopes / SENSOR.slope_per_px, variance / SENSOR.slope_per_px**2)
    made = Wavefront.of(SENSOR, FIELD, displacement, ZonalSolution(SENSOR, displacement))
    made.views.setflags(write=True)  # tests change them
    return made


def modal(
    coefficients: Floats,
    *,
    sigma_px: float | Floats = 0.01,
    basis: PupilBasis = "legendre",
    noise: np.random.Generator | None = None,
) -> Wavefront:
    """A wavefront with coefficients e_pq (pupil_mode, field_mode), rad, from displacements with a known error.

    `sigma_px` is alike for all, or has a value for each field mode and axis, (field_mode, xy). Without `noise` the
    displacements are exact.
    """
    modes, count = pupil_modes(SENSOR, basis, len(coefficients)), coefficients.shape[1]
    slopes = np.einsum("pq,prcd->rcqd", coefficients, modes.gradients)
    pixels = slopes / SENSOR.slope_per_px
    if noise is not None:
        pixels = pixels + noise.normal(0, sigma_px, pixels.shape)
    displacement = converged(LegendreModes(count), pixels, np.full(pixels.shape, sigma_px**2))
    parameters = np.eye(2 * count)
    solver = ModalSolver(modes, MeanGradients(SENSOR, parameters), parameters, displacement.covariance)
    made = Wavefront.of(SENSOR, FIELD, displacement, solver(displacement))
    made.views.setflags(write=True)  # as above
    return made
