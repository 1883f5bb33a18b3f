"""Displacements of a layer's polynomials against brute-force quadrature over lenslets and field."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.polynomial import legendre as series
from support.optics import FIELD, sensor_of

from reconstruction.arrays import Floats
from reconstruction.displacement import diagonal_covariance
from reconstruction.geometry import Arrangement, Field
from reconstruction.layers.layer_solver import LayerDesign, layer_orders
from reconstruction.modes.field_modes import LegendreModes, ZernikeModes, gradient_basis
from reconstruction.solve.expected_errors import ExpectedErrors, MeanGradients

DEGREE = 4  # whose gradients over a lenslet local wavefronts hold exactly, and whose change over the field the modes
ROWS, COLUMNS = 4, 3
SIGMA_PX = 1.0


def aperture(arrangement: Arrangement, pitch_m: float) -> Floats:
    """Points of a fine grid inside a lenslet about its centre, (point, xy), m."""
    steps = (np.arange(60) + 0.5) / 60 - 0.5
    x, y = (grid.ravel() for grid in np.meshgrid(steps, steps * 1.2))
    if arrangement == "square":
        return np.asarray(np.stack([x, y / 1.2], axis=-1) * pitch_m)
    inside = np.abs(y) + np.abs(x) / np.sqrt(3) < 1 / np.sqrt(3)  # corners at +-y
    return np.asarray(np.stack([x, y], axis=-1)[inside] * pitch_m)


def field_points(field: Field) -> tuple[Floats, Floats]:
    """Normalised field positions (point, xy), and weights (point,)."""
    if field.shape == "square":
        nodes, weights = series.leggauss(6)
        x, y = (grid.ravel() for grid in np.meshgrid(nodes, nodes))
        return np.stack([x, y], axis=-1), np.outer(weights, weights).ravel()
    square, weights = series.leggauss(8)  # of the radius
    radius, angle = np.sqrt((square + 1) / 2), np.arange(16) * np.pi / 8
    x, y = (np.outer(radius, of(angle)).ravel() for of in (np.cos, np.sin))
    return np.stack([x, y], axis=-1), np.repeat(weights, 16)


@pytest.mark.slow
@pytest.mark.parametrize("ratio", [-0.975, 0.6])
@pytest.mark.parametrize("arrangement", ["square", "hexagonal"])
@pytest.mark.parametrize("shape", ["square", "circle"])
def test_rows_are_mean_gradients(ratio: float, arrangement: Arrangement, shape: str) -> None:
    sensor = replace(sensor_of(ROWS, COLUMNS), arrangement=arrangement)
    field = replace(FIELD, shape=shape, view_spacing_m=0.4e-3)  # type: ignore[arg-type] # parametrised
    modes = LegendreModes(15) if shape == "square" else ZernikeModes(15)
    parameters = gradient_basis(modes)
    variance = np.full((ROWS, COLUMNS, 15, 2), SIGMA_PX**2)
    everywhere = np.ones((ROWS, COLUMNS), np.bool_)
    errors = ExpectedErrors(MeanGradients(sensor, parameters), parameters, diagonal_covariance(variance), everywhere)
    design = LayerDesign(sensor, field, modes, errors)
    found = design.rows(ratio, DEGREE)  # (L, K, k)

    half_m = np.array(sensor.pupil_half_width_m) + abs(ratio) * field.half_width_m
    np.testing.assert_allclose(design.footprint_m(ratio), half_m)
    at, weights = field_points(field)
    of_lenslet = aperture(arrangement, sensor.lenslet_pitch_m)
    values = modes.values(*at.T)
    project = np.linalg.solve((values * weights) @ values.T, values * weights)
    unit = np.eye(DEGREE + 1)
    some = [0, 4, 11]  # in even and odd rows
    expected = np.zeros((len(some), *found.shape[1:]))
    for lenslet, number in enumerate(some):
        center_m = sensor.lenslet_centers_m.reshape(-1, 2)[number]
        s, t = np.moveaxis((center_m + of_lenslet + ratio * at[:, None] * field.half_width_m) / half_m, -1, 0)
        for k, (i, j) in enumerate(layer_orders(DEGREE)):
            along, across = series.Legendre(unit[i]), series.Legendre(unit[j])
            slope_s, slope_t = along.deriv()(s) * across(t) / half_m[0], along(s) * across.deriv()(t) / half_m[1]
            slopes = np.stack([slope_s.mean(axis=1), slope_t.mean(axis=1)], axis=-1)  # (field point, xy)
            px = (project @ slopes / sensor.slope_per_px).T.ravel()  # x modes, y modes
            expected[lenslet, :, k] = parameters @ px
    np.testing.assert_allclose(found[some], expected, atol=1e-3 * np.abs(expected).max())
