"""Hexagonal lattices: closed forms of their geometry, of wavefronts on them and of means over hexagons."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.optics import converged, sensor_of

from reconstruction.arrays import Floats
from reconstruction.geometry import Lattice, lenslet_centers
from reconstruction.modes.field_modes import LegendreModes
from reconstruction.modes.pupil_modes import pupil_modes
from reconstruction.settings import PupilBasis
from reconstruction.solve.zonal import ZonalSolution, zonal_wavefront

SENSOR = replace(sensor_of(6, 7), arrangement="hexagonal")
PITCH_M, HEIGHT = SENSOR.lenslet_pitch_m, np.sqrt(3) / 2
X, Y = np.moveaxis(SENSOR.lenslet_centers_m / PITCH_M, -1, 0)


def test_inner_lenslets_have_six_neighbours_one_pitch_away() -> None:
    centers = lenslet_centers("hexagonal", 7, 6)
    away = np.linalg.norm(centers.reshape(-1, 1, 2) - centers.reshape(1, -1, 2), axis=-1)
    away[np.diag_indices_from(away)] = np.inf
    assert away.min() == pytest.approx(1)
    neighbours = np.sum(away < 1.001, axis=1).reshape(7, 6)
    assert (neighbours[1:-1, 1:-1] == 6).all()


def test_odd_rows_lie_half_a_pitch_to_the_right() -> None:
    centers = lenslet_centers("hexagonal", 4, 5)
    np.testing.assert_allclose(centers[1] - centers[0], np.tile([0.5, HEIGHT], (5, 1)), atol=1e-12)
    np.testing.assert_allclose(centers[2] - centers[1], np.tile([-0.5, HEIGHT], (5, 1)), atol=1e-12)
    np.testing.assert_allclose(centers.mean(axis=(0, 1)), 0, atol=1e-12)


def test_lattice_on_the_camera_turns_and_stretches_the_same_centres() -> None:
    lattice = Lattice(center_x_px=90.0, center_y_px=70.0, pitch_px=20.0, rotation_rad=0.1, arrangement="hexagonal")
    turn = np.array([[np.cos(0.1), np.sin(0.1)], [-np.sin(0.1), np.cos(0.1)]])
    found = lattice.lenslet_centers_px(6, 7)
    np.testing.assert_allclose(found, 20 * np.stack([X, Y], axis=-1) @ turn + [90, 70], atol=1e-9)


def test_cells_are_rectangles_that_tile_the_lattice() -> None:
    lattice = Lattice(center_x_px=90.0, center_y_px=70.0, pitch_px=20.0, rotation_rad=0.1, arrangement="hexagonal")
    position_px = np.random.default_rng(0).uniform(0, 180, (500, 2))
    cell, beside_px, inside = lattice.cells_at(position_px, 6, 7)
    assert 100 < inside.sum() < 400
    assert (np.abs(beside_px) <= [10, 10 * HEIGHT]).all()
    turn = np.array([[np.cos(0.1), np.sin(0.1)], [-np.sin(0.1), np.cos(0.1)]])
    centers = lattice.lenslet_centers_px(6, 7)[cell[inside, 1], cell[inside, 0]]
    np.testing.assert_allclose(centers + beside_px[inside] @ turn, position_px[inside], atol=1e-9)


def quadratic(x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """A wavefront in units of the pitch, and its slopes; Southwell's mean of slopes is exact for it."""
    slopes = np.stack([0.3 + 0.1 * x - 0.08 * y, -0.7 - 0.08 * x + 0.04 * y], axis=-1)
    return 0.3 * x - 0.7 * y + 0.05 * x**2 - 0.08 * x * y + 0.02 * y**2, slopes


def test_zonal_is_exact_for_quadratic_wavefronts_with_a_lost_lenslet() -> None:
    phase, slopes = quadratic(X, Y)
    valid = np.ones(X.shape, bool)
    valid[2, 3] = valid[5, 0] = False
    slopes[~valid] = np.nan
    found = zonal_wavefront(slopes / PITCH_M, valid, pitch_m=PITCH_M, arrangement="hexagonal")
    assert np.isnan(found[~valid]).all()
    np.testing.assert_allclose(found[valid], phase[valid] - phase[valid].mean(), atol=1e-10)


def test_zonal_uses_all_three_directions() -> None:
    """Two lenslets that only one slanted direction joins; both directions, in both kinds of rows."""
    phase, slopes = quadratic(X, Y)
    for one, other in (((2, 3), (3, 3)), ((2, 3), (3, 2)), ((3, 2), (4, 2)), ((3, 2), (4, 3))):
        valid = np.zeros(X.shape, bool)
        valid[one] = valid[other] = True
        found = zonal_wavefront(slopes / PITCH_M, valid, pitch_m=PITCH_M, arrangement="hexagonal")
        assert found[other] - found[one] == pytest.approx(phase[other] - phase[one])


def test_zonal_error_bars_are_the_scatter_of_noisy_wavefronts() -> None:
    generator, valid = np.random.default_rng(1), np.ones(X.shape, bool)
    root = generator.normal(size=(*X.shape, 2, 2))
    covariance = (root @ np.swapaxes(root, -1, -2))[:, :, None, :, None, :]
    noise = np.einsum("rcab,nrcb->nrca", root, generator.normal(size=(4000, *X.shape, 2)))
    noise *= SENSOR.slope_per_px
    scatter = zonal_wavefront(noise, valid, pitch_m=PITCH_M, arrangement="hexagonal").std(axis=0)
    still = np.zeros((*X.shape, 1, 2))
    measured = replace(converged(LegendreModes(1), still, still), covariance_source=covariance)
    solution = ZonalSolution(SENSOR, measured)
    np.testing.assert_allclose(solution.sigma(np.ones(1)), scatter, rtol=0.08)


def test_mean_gradient_over_a_hexagon_in_closed_form() -> None:
    """The mean square of x over a hexagon is 5/72 of its squared width: P_3 has this mean gradient."""
    gradients = pupil_modes(SENSOR, "legendre", 10).gradients
    half_x, half_y = (half_m / PITCH_M for half_m in SENSOR.pupil_half_width_m)
    assert (half_x, half_y) == pytest.approx((7.5 / 2, 6 * HEIGHT / 2))
    for mode, axis, at, half in ((6, 0, X, half_x), (9, 1, Y, half_y)):
        expected = (7.5 * (at**2 + 5 / 72) / half**2 - 1.5) / (half * PITCH_M)
        np.testing.assert_allclose(gradients[mode, ..., axis], expected, rtol=1e-9)
        np.testing.assert_allclose(gradients[mode, ..., 1 - axis], 0, atol=1e-9)


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize("basis", ["legendre", "zernike"])
def test_mean_gradient_is_that_between_the_edges_of_fine_hexagons(basis: PupilBasis) -> None:
    """Of the polynomial itself at many points that are nearest to the lenslet."""
    modes = pupil_modes(SENSOR, basis, 36)
    steps = (np.arange(240) + 0.5) / 200 - 0.6  # pitches
    x, y = (along.ravel() for along in np.meshgrid(steps, steps))
    angle = np.arange(6) * np.pi / 3
    x, y = (at[np.max(np.outer(np.cos(angle), x) + np.outer(np.sin(angle), y), axis=0) < 0.5] for at in (x, y))
    half_m = np.array(SENSOR.pupil_half_width_m)
    for row, column in ((0, 0), (3, 6), (2, 3)):
        u, v = (X[row, column] + x) * PITCH_M / half_m[0], (Y[row, column] + y) * PITCH_M / half_m[1]
        tiny = 1e-5

        def values(u: Floats, v: Floats) -> Floats:
            return np.asarray(np.polynomial.legendre.legval2d(v, u, np.moveaxis(modes.products, 0, -1)))

        along_x = (values(u + tiny, v) - values(u - tiny, v)).mean(axis=-1) / (2 * tiny * half_m[0])
        along_y = (values(u, v + tiny) - values(u, v - tiny)).mean(axis=-1) / (2 * tiny * half_m[1])
        largest = np.maximum(np.abs(modes.gradients).max(axis=(1, 2, 3)), 1.0)
        np.testing.assert_allclose(modes.gradients[:, row, column, 0] / largest, along_x / largest, atol=3e-3)
        np.testing.assert_allclose(modes.gradients[:, row, column, 1] / largest, along_y / largest, atol=3e-3)


def test_lenslet_columns_have_no_common_position() -> None:
    with pytest.raises(ValueError, match="only in a square lattice"):
        _ = SENSOR.pupil_x_m
