"""Residual of the slopes of known polynomials."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.optics import FIELD, SmallBench, converged, sensor_of

from reconstruction.arrays import Floats
from reconstruction.displacement import Displacement
from reconstruction.modes.field_modes import LegendreModes
from reconstruction.modes.pupil_modes import pupil_modes
from reconstruction.quality.slope_residual import slope_residual
from reconstruction.solve.zonal import ZonalSolution
from reconstruction.wavefront import Wavefront, without_piston

SENSOR = sensor_of(7, 9)
U, V = np.meshgrid(SENSOR.pupil_x_m, SENSOR.pupil_y_m)
BOWL = 4e5 * U * U - 3e5 * U * V + 800 * V
SLOPES = np.stack([8e5 * U - 3e5 * V, -3e5 * U + 800], axis=-1)  # of the bowl, rad/m


def displacement() -> Displacement:
    """Displacement of a bowl that doubles from the middle of the field to its +x edge."""
    coefficients = np.stack([SLOPES, SLOPES, np.zeros_like(SLOPES)], axis=2) / SENSOR.slope_per_px
    return converged(LegendreModes(3), coefficients, coefficients**2)


def over_the_field(phase: Floats) -> Floats:
    return np.tile(1 + np.array([-5, 0, 5])[:, None, None] / 6, (3, 1, 1, 1)) * without_piston(phase)


def test_modal_fit_is_compared_with_slopes(small_bench: SmallBench) -> None:
    modes = pupil_modes(SENSOR, "legendre", 3)  # piston and tilt: the fit lacks the curvature
    wavefront = small_bench.reconstructor(warp="affine", pupil_modes=3).solve(displacement())
    residual = slope_residual(wavefront, modes)
    np.testing.assert_allclose(wavefront.views + residual, over_the_field(BOWL), atol=1e-6)


def test_complete_fit_leaves_no_residual(small_bench: SmallBench) -> None:
    modes = pupil_modes(SENSOR, "legendre", 10)
    coefficients = np.zeros((7, 9, 3, 2))
    coefficients[:, :, 0] = modes.gradients[8] / SENSOR.slope_per_px  # a cubic, which zonal integration approximates
    measured = replace(displacement(), coefficients=coefficients)
    wavefront = small_bench.reconstructor(warp="affine", pupil_modes=10).solve(measured)
    np.testing.assert_allclose(slope_residual(wavefront, modes), 0, atol=1e-6)


def test_zonal_is_compared_with_best_fitting_modes() -> None:
    measured = displacement()
    wavefront = Wavefront.of(SENSOR, FIELD, measured, ZonalSolution(SENSOR, measured))
    enough = slope_residual(wavefront, pupil_modes(SENSOR, "legendre", 6))
    np.testing.assert_allclose(enough, 0, atol=1e-9)
    too_few = slope_residual(wavefront, pupil_modes(SENSOR, "legendre", 3))
    curvature = 4e5 * (U * U - np.mean(U * U)) - 3e5 * U * V  # by symmetry it has no tilt
    np.testing.assert_allclose(too_few, over_the_field(curvature), atol=1e-9)


@pytest.mark.parametrize("row", [0, 3])
def test_unknown_lenslets_are_not_compared(row: int) -> None:
    valid = np.ones(U.shape, np.bool_)
    valid[row, 4] = False
    measured = displacement()
    measured.outcome[~valid] = 3
    solution = ZonalSolution(SENSOR, measured)
    residual = slope_residual(Wavefront.of(SENSOR, FIELD, measured, solution), pupil_modes(SENSOR, "zernike", 6))
    outside = (np.hypot(U, V) > SENSOR.pupil_half_width_m[1]) | ~valid
    np.testing.assert_array_equal(np.isnan(residual), np.broadcast_to(outside, residual.shape))
    np.testing.assert_allclose(residual[..., ~outside], 0, atol=1e-9)
