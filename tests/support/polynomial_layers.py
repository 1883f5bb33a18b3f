"""Polynomial layers in closed form: their displacements, wavefronts and light, and a solver for them."""

from __future__ import annotations

import numpy as np
from numpy.polynomial import legendre as series
from numpy.polynomial import polynomial as powers

from reconstruction.arrays import Floats
from reconstruction.displacement import Displacement, diagonal_covariance
from reconstruction.geometry import centered_steps
from reconstruction.layers.layer_solver import LayerSolver
from reconstruction.modes.field_modes import LegendreModes, gradient_basis
from reconstruction.modes.layered_modes import layered_wavefronts
from reconstruction.modes.pupil_modes import pupil_modes
from reconstruction.solve.expected_errors import MeanGradients
from reconstruction.solve.modal import ModalSolver
from support.optics import FIELD, sensor_of

SENSOR = sensor_of(7, 9)
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
    u_mm = (centered_steps(SENSOR.lenslets[1])[:, None] * 2 + nodes) * half_mm  # (column, node)
    v_mm = (centered_steps(SENSOR.lenslets[0])[:, None] * 2 + nodes) * half_mm
    x_mm = nodes * FIELD.half_width_m * 1e3
    s_x = u_mm[:, :, None] + ratio * x_mm  # (column, node, field x)
    s_y = v_mm[:, :, None] + ratio * x_mm
    fields = np.array([series.legval(nodes, row) for row in np.eye(5)])  # P_a at the nodes
    project = fields * weights * (np.arange(5)[:, None] + 0.5)
    orders = [(degree - n, n) for degree in range(5) for n in range(degree + 1)]
    found = np.zeros((*SENSOR.lenslets, len(orders), 2))
    for axis, derivative in enumerate((powers.polyder(phase, axis=1), powers.polyder(phase, axis=0))):
        values = powers.polygrid2d(s_y.ravel(), s_x.ravel(), derivative)  # rad/mm
        values = values.reshape(*s_y.shape, *s_x.shape)  # (row, node, field y, column, node, field x)
        mean = np.einsum("rnycmx,n,m->rycx", values, weights / 2, weights / 2)
        every = np.einsum("rycx,by,ax->rcab", mean, project, project)
        found[..., axis] = np.stack([every[..., a, b] for a, b in orders], axis=-1)
    return found * 1e3 / SENSOR.slope_per_px


def wavefront(phase: Floats, ratio: float, x_m: float, y_m: float) -> Floats:
    """Wavefront of a field position at the lenslet centres, rad, without piston, (lenslet_row, lenslet_column)."""
    u_mm, v_mm = (SENSOR.pupil_x_m + ratio * x_m) * 1e3, (SENSOR.pupil_y_m + ratio * y_m) * 1e3
    values = powers.polygrid2d(v_mm, u_mm, phase)
    return np.asarray(values - values.mean())


def light(phase: Floats, ratio: float, u_m: Floats, v_m: Floats, x_m: float, y_m: float) -> tuple[Floats, Floats]:
    """Phase, rad, and amplitude in real light at pupil positions u (1, column) and v (row, 1).

    The amplitude is sqrt(det(1 + f1/k ratio H)), H the layer's second derivatives at u + ratio x.
    """
    s_mm, t_mm = (u_m.ravel() + ratio * x_m) * 1e3, (v_m.ravel() + ratio * y_m) * 1e3
    along_s, along_t = powers.polyder(phase, axis=1), powers.polyder(phase, axis=0)
    gathered = ratio * FIELD.collimator_focal_length_m / SENSOR.wavenumber_rad_per_m * 1e6
    ss, tt, st = (
        gathered * powers.polygrid2d(t_mm, s_mm, curvature)
        for curvature in (powers.polyder(along_s, axis=1), powers.polyder(along_t), powers.polyder(along_s))
    )
    values = powers.polygrid2d(t_mm, s_mm, phase)
    return np.asarray(values, np.float64), np.asarray(np.sqrt((1 + ss) * (1 + tt) - st**2), np.float64)


def solver(modes: LegendreModes = MODES, hidden: int = 0) -> LayerSolver:
    """Solver for displacements with the error NOISE_PX, and mean gradients."""
    parameters, smooth = gradient_basis(modes), pupil_modes(SENSOR, "legendre", None)
    variance = np.full((*SENSOR.lenslets, modes.count, 2), NOISE_PX**2)
    free = ModalSolver(
        smooth,
        MeanGradients(SENSOR, parameters),
        parameters,
        diagonal_covariance(variance),
        layered=layered_wavefronts(SENSOR, smooth, modes, parameters),
        field_degree=modes.degree,
    )
    return LayerSolver(SENSOR, FIELD, modes, free, hidden=hidden)


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
