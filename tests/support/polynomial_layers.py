"""Displacements of polynomial layers in closed form, and a solver for them."""

from __future__ import annotations

import numpy as np
from numpy.polynomial import legendre as series
from numpy.polynomial import polynomial as powers

from reconstruction.arrays import Floats
from reconstruction.displacement import Displacement, diagonal_covariance
from reconstruction.geometry import Field, Sensor, centered_steps
from reconstruction.layers.layer_solver import LayerSolver
from reconstruction.modes.field_modes import LegendreModes, gradient_basis
from reconstruction.modes.layered_modes import layered_wavefronts
from reconstruction.modes.pupil_modes import pupil_modes
from reconstruction.solve.modal import ModalSolver
from reconstruction.solve.sensitivity import MeanGradients

SENSOR = Sensor(
    lenslet_rows=7,
    lenslet_columns=9,
    lenslet_pitch_m=500e-6,
    lenslet_focal_length_m=46.7e-3,
    wavelength_m=462e-9,
    pixel_pitch_m=16e-6,
)
FIELD = Field(collimator_focal_length_m=0.2, half_width_m=0.6e-3)
MODES = LegendreModes(15)
NOISE_PX = 0.01
# Phi = sum c[j, i] x^i y^j, rad, x and y in mm: no symmetry
PHASE = np.array([[0.0, 0.3, 0.8, 0.25], [-0.4, 1.1, -0.3, 0.0], [-0.9, 0.35, 0.0, 0.0], [0.2, 0.0, 0.0, 0.0]])
OTHER = np.array([[0.0, 0.0, -0.5, -0.2], [0.0, 0.7, 0.4, 0.0], [0.6, -0.3, 0.0, 0.0], [-0.25, 0.0, 0.0, 0.0]])


def displacements_px(phase: Floats, ratio: float) -> Floats:
    """Mean slopes over each lenslet in the field modes, (lenslet_row, lenslet_column, field_mode, xy).

    By Gauss quadrature of the phase's derivatives at u + ratio x, over lenslet and field.
    """
    nodes, weights = series.leggauss(6)
    half_mm = SENSOR.lenslet_pitch_m / 2 * 1e3
    u_mm = (centered_steps(SENSOR.lenslet_columns)[:, None] * 2 + nodes) * half_mm  # (column, node)
    v_mm = (centered_steps(SENSOR.lenslet_rows)[:, None] * 2 + nodes) * half_mm
    x_mm = nodes * FIELD.half_width_m * 1e3
    s_x = u_mm[:, :, None] + ratio * x_mm  # (column, node, field x)
    s_y = v_mm[:, :, None] + ratio * x_mm
    fields = np.array([series.legval(nodes, row) for row in np.eye(5)])  # P_a at the nodes
    project = fields * weights * (np.arange(5)[:, None] + 0.5)
    orders = [(degree - n, n) for degree in range(5) for n in range(degree + 1)]
    found = np.zeros((SENSOR.lenslet_rows, SENSOR.lenslet_columns, len(orders), 2))
    for axis, derivative in enumerate((powers.polyder(phase, axis=1), powers.polyder(phase, axis=0))):
        values = powers.polygrid2d(s_y.ravel(), s_x.ravel(), derivative)  # rad/mm
        values = values.reshape(*s_y.shape, *s_x.shape)  # (row, node, field y, column, node, field x)
        mean = np.einsum("rnycmx,n,m->rycx", values, weights / 2, weights / 2)
        every = np.einsum("rycx,by,ax->rcab", mean, project, project)
        found[..., axis] = np.stack([every[..., a, b] for a, b in orders], axis=-1)
    return found * 1e3 / SENSOR.slope_per_px


def solver(modes: LegendreModes = MODES, hidden: int = 0) -> LayerSolver:
    parameters = gradient_basis(modes)
    variance = np.full((SENSOR.lenslet_rows, SENSOR.lenslet_columns, modes.count, 2), NOISE_PX**2)
    smooth = pupil_modes(SENSOR, "legendre", None)
    layered = layered_wavefronts(SENSOR, smooth, modes, parameters)
    covariance, sensitivity = diagonal_covariance(variance), MeanGradients(SENSOR, parameters)
    free = ModalSolver(smooth, sensitivity, parameters, covariance, layered=layered, field_degree=modes.degree)
    return LayerSolver(SENSOR, FIELD, modes, free, hidden)


def displacement(coefficients: Floats, *, lost: int = 0) -> Displacement:
    """Displacements of which the first lenslets are lost."""
    shape = coefficients.shape[:2]
    outcome, unknown = np.zeros(shape, np.int8), np.full(shape, np.nan)
    outcome.ravel()[:lost] = 1
    coefficients = np.where((outcome == 0)[..., None, None], coefficients, np.nan)
    variance = diagonal_covariance(np.full(coefficients.shape, NOISE_PX**2))
    return Displacement(MODES, coefficients, variance, outcome, unknown, unknown, unknown)


def noisy(coefficients: Floats, seed: int) -> Floats:
    return coefficients + np.random.default_rng(seed).normal(0, NOISE_PX, coefficients.shape)
