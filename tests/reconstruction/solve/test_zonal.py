"""Southwell's equations against wavefronts with closed-form slopes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.optics import converged, sensor_of

from reconstruction.modes.field_modes import SampledModes
from reconstruction.solve.zonal import ZonalSolution, zonal_wavefront

PITCH_M = 2.0
ROWS, COLUMNS = 5, 8
Y, X = np.meshgrid(np.arange(ROWS) * PITCH_M, np.arange(COLUMNS) * PITCH_M, indexing="ij")
# Southwell's mean of neighbouring slopes is exact for every wavefront of second degree.
QUADRATIC = 0.3 * X - 0.7 * Y + 0.05 * X**2 - 0.08 * X * Y + 0.02 * Y**2
SLOPES = np.stack([0.3 + 0.1 * X - 0.08 * Y, -0.7 - 0.08 * X + 0.04 * Y], axis=-1)


def test_quadratic_wavefront_is_exact() -> None:
    wavefront = zonal_wavefront(SLOPES, np.ones((ROWS, COLUMNS), bool), pitch_m=PITCH_M, arrangement="square")
    np.testing.assert_allclose(wavefront, QUADRATIC - QUADRATIC.mean(), atol=1e-10)


def test_leading_axes_are_integrated_at_once() -> None:
    both = np.stack([SLOPES, -2 * SLOPES])
    wavefronts = zonal_wavefront(both, np.ones((ROWS, COLUMNS), bool), pitch_m=PITCH_M, arrangement="square")
    np.testing.assert_allclose(wavefronts[1], -2 * wavefronts[0], atol=1e-10)


def test_lost_lenslet_is_nan_and_does_not_affect_others() -> None:
    valid = np.ones((ROWS, COLUMNS), bool)
    valid[2, 3] = False
    slopes = SLOPES.copy()
    slopes[2, 3] = np.nan
    wavefront = zonal_wavefront(slopes, valid, pitch_m=PITCH_M, arrangement="square")
    assert np.isnan(wavefront[2, 3])
    expected = QUADRATIC - QUADRATIC[valid].mean()
    np.testing.assert_allclose(wavefront[valid], expected[valid], atol=1e-10)


def test_only_largest_connected_set_is_known() -> None:
    valid = np.ones((ROWS, COLUMNS), bool)
    valid[:, 2] = False
    wavefront = zonal_wavefront(SLOPES, valid, pitch_m=PITCH_M, arrangement="square")
    assert np.isnan(wavefront[:, :3]).all()
    assert np.isfinite(wavefront[:, 3:]).all()


@pytest.mark.parametrize("lenslets", [[], [(0, 0)], [(0, 0), (2, 2)]])
def test_lenslets_without_neighbours_are_unknown(lenslets: list[tuple[int, int]]) -> None:
    valid = np.zeros((ROWS, COLUMNS), bool)
    for place in lenslets:
        valid[place] = True
    assert np.isnan(zonal_wavefront(SLOPES, valid, pitch_m=PITCH_M, arrangement="square")).all()


def test_least_squares_matches_dense_solution() -> None:
    slopes = np.random.default_rng(0).normal(size=(ROWS, COLUMNS, 2))
    rows, data = [], []
    for r in range(ROWS):
        for c in range(COLUMNS):
            for r2, c2, axis in ((r, c + 1, 0), (r + 1, c, 1)):
                if r2 < ROWS and c2 < COLUMNS:
                    equation = np.zeros((ROWS, COLUMNS))
                    equation[r2, c2], equation[r, c] = 1, -1
                    rows.append(equation.ravel())
                    data.append((slopes[r, c, axis] + slopes[r2, c2, axis]) / 2 * PITCH_M)
    expected = np.linalg.lstsq(np.array(rows), np.array(data), rcond=None)[0].reshape(ROWS, COLUMNS)
    wavefront = zonal_wavefront(slopes, np.ones((ROWS, COLUMNS), bool), pitch_m=PITCH_M, arrangement="square")
    np.testing.assert_allclose(wavefront, expected - expected.mean(), atol=1e-10)


def test_weighted_least_squares_and_sigma_match_dense_solution() -> None:
    generator = np.random.default_rng(5)
    weights, sensor = generator.uniform(0.1, 10, (ROWS, COLUMNS)), sensor_of(ROWS, COLUMNS)
    index = np.arange(ROWS * COLUMNS).reshape(ROWS, COLUMNS)
    pairs = [(a, b, 0) for a, b in zip(index[:, :-1].ravel(), index[:, 1:].ravel(), strict=True)]
    pairs += [(a, b, 1) for a, b in zip(index[:-1].ravel(), index[1:].ravel(), strict=True)]
    difference, mean, root = np.zeros((len(pairs), index.size)), np.zeros((len(pairs), index.size, 2)), []
    for row, (a, b, axis) in enumerate(pairs):
        difference[row, a], difference[row, b] = -1, 1
        mean[row, [a, b], axis] = sensor.lenslet_pitch_m / 2
        root.append(np.sqrt(1 / (1 / weights.flat[a] + 1 / weights.flat[b])))
    inverse = np.linalg.pinv(np.array(root)[:, None] * difference) * np.array(root)
    by_slope = np.einsum("np,pla->nla", inverse, mean)  # derivative of the wavefront with respect to each slope
    px = generator.normal(size=(ROWS, COLUMNS, 2, 2))
    spread = generator.normal(size=(ROWS, COLUMNS, 4, 4))
    covariance = (spread @ np.swapaxes(spread, 2, 3)).reshape(ROWS, COLUMNS, 2, 2, 2, 2)
    view = np.array([0.7, -1.2])
    measured = replace(
        converged(SampledModes(np.array([-1.0, 1.0]), np.zeros(1)), px, px), covariance_source=covariance
    )
    solution = ZonalSolution(sensor, measured, weights)

    by_px = by_slope * sensor.slope_per_px
    at_view = np.einsum("q,rcqa->rca", view, px).reshape(-1, 2)
    expected = np.einsum("nla,la->n", by_px, at_view).reshape(ROWS, COLUMNS)
    np.testing.assert_allclose(solution.wavefront(view), expected, atol=1e-9)
    noise = np.einsum("q,lqarb,r->lab", view, covariance.reshape(-1, 2, 2, 2, 2), view)
    variance = np.einsum("nla,lab,nlb->n", by_px, noise, by_px).reshape(ROWS, COLUMNS)
    np.testing.assert_allclose(solution.sigma(view), np.sqrt(variance), rtol=1e-9)
