"""Images behind hexagonal lenslets against the Fourier transform of a hexagon and the slopes of wavefronts."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from support.optics import FIELD, phase_only, sensor_of

from reconstruction.arrays import Floats, Image
from reconstruction.geometry import Field, Lattice, nominal_lattice
from simulated_devices.optics.forward_model import ForwardModel
from simulated_devices.optics.phase_screen import PhaseScreen
from simulated_devices.optics.screen_light import RayMap, truth_wavefront
from simulated_devices.optics.source import SourcePoints

SENSOR = replace(sensor_of(6, 5), arrangement="hexagonal")
SHAPE = (180, 190)
LATTICE = replace(nominal_lattice(SENSOR, *SHAPE), rotation_rad=0.02)
ON_AXIS = SourcePoints(position_m=np.zeros((1, 2)), area_m2=np.ones(1))


def model(lattice: Lattice = LATTICE, border_lenslets: int = 0, pupil_samples: int = 12) -> ForwardModel:
    rows, columns = SHAPE
    return ForwardModel(
        SENSOR,
        lattice,
        FIELD,
        shape=(rows, columns),
        pupil_samples=pupil_samples,
        border_lenslets=border_lenslets,
        pixel_fill_factor=0.0,
    )


def hexagon_transform(frequency_x: Floats, frequency_y: Floats) -> Floats:
    """Fourier transform of a hexagon of width 1 with corners at +-y, over its area.

    The integral of the plane wave over the area becomes one over its edges (divergence theorem).
    """
    angle = np.arange(7) * np.pi / 3 + np.pi / 6
    corner = np.stack([np.cos(angle), np.sin(angle)], axis=-1) / np.sqrt(3)
    wave = 2 * np.pi * np.stack([frequency_x, frequency_y], axis=-1)
    total = np.zeros(frequency_x.shape, complex)
    for one, other in itertools.pairwise(corner):
        edge = other - one
        along = wave @ edge / 2
        normal = wave @ np.array([edge[1], -edge[0]])
        total += normal * np.exp(-1j * wave @ (one + other) / 2) * np.sinc(along / np.pi)
    return np.asarray((total * 1j / np.sum(wave**2, axis=-1)).real / (np.sqrt(3) / 2))


def test_point_image_is_the_transform_of_a_hexagon() -> None:
    image = model(pupil_samples=40).irradiance(ON_AXIS)
    row, column = np.mgrid[: SHAPE[0], : SHAPE[1]]
    cosine, sine = np.cos(0.02), np.sin(0.02)
    for at in ((0, 0), (3, 4), (2, 1)):
        x_px, y_px = LATTICE.lenslet_centers_px(6, 5)[at]
        beside_x, beside_y = column - x_px, row - y_px
        along_x, along_y = cosine * beside_x + sine * beside_y, cosine * beside_y - sine * beside_x
        own = (np.abs(along_x) < 13) & (np.abs(along_y) < 13)
        per_px = 16e-6 * 500e-6 / (462e-9 * 46.7e-3)  # cycles over the lenslet's width
        expected = hexagon_transform(along_x[own] * per_px, along_y[own] * per_px) ** 2
        # All light of the lenslet: the peak is area / (wavelength f)^2.
        expected *= np.sqrt(3) / 2 * (500e-6 * 16e-6 / (462e-9 * 46.7e-3)) ** 2
        np.testing.assert_allclose(image[own], expected, atol=4e-3 * expected.max())


def curved(x_m: Floats, y_m: Floats) -> Floats:
    return np.asarray(0.5e6 * x_m**2 - 0.3e6 * x_m * y_m + 0.2e6 * y_m**2 + 300 * x_m)


def test_spots_move_by_the_slope_at_the_centres_of_their_hexagons() -> None:
    forward = model()
    phase = curved(forward.sample_x_m, forward.sample_y_m[:, None]).astype(np.float32)

    def at_point(_x_m: float, _y_m: float) -> Image:
        return phase

    reference, frame = forward.irradiance(ON_AXIS), forward.irradiance(ON_AXIS, phase_only(at_point))
    row, column = np.mgrid[: SHAPE[0], : SHAPE[1]]
    turn = np.array([[np.cos(0.02), np.sin(0.02)], [-np.sin(0.02), np.cos(0.02)]])
    k_over_f = 2 * np.pi / 462e-9 / 46.7e-3
    for (x_m, y_m), (x_px, y_px) in zip(
        SENSOR.lenslet_centers_m.reshape(-1, 2), LATTICE.lenslet_centers_px(6, 5).reshape(-1, 2), strict=True
    ):
        slope = np.array([1.0e6 * x_m - 0.3e6 * y_m + 300, -0.3e6 * x_m + 0.4e6 * y_m])
        expected_px = slope / k_over_f / 16e-6 @ turn
        moved_px = []
        for image, (dx, dy) in ((reference, (0.0, 0.0)), (frame, expected_px)):
            weight = image * (np.hypot(column - x_px - dx, row - y_px - dy) < 4)
            moved_px.append(np.array([np.sum(weight * column), np.sum(weight * row)]) / weight.sum())
        np.testing.assert_allclose(moved_px[1] - moved_px[0], expected_px, atol=0.05)


def test_image_does_not_repeat_within_a_cell() -> None:
    """The period of the sampled transform, for a point at the field's edge, must be that of square lenslets."""
    at_the_edge = SourcePoints(position_m=np.array([[0.6e-3, 0.0]]), area_m2=np.ones(1))
    lattice = replace(LATTICE, rotation_rad=0.0)
    image = model(lattice, pupil_samples=10).irradiance(at_the_edge)
    x_px, y_px = lattice.lenslet_centers_px(6, 5)[3, 2]
    row, column = np.mgrid[: SHAPE[0], : SHAPE[1]]
    far = (np.abs(row - y_px) < 12) & (column > x_px - 15.5) & (column < x_px - 11)
    assert image[far].max() < 0.02 * image.max()


@pytest.mark.parametrize("border_lenslets", [1, 2])
def test_lenslets_around_the_sensor_change_nothing_on_it(border_lenslets: int) -> None:
    inside = LATTICE.cells_at(np.moveaxis(np.mgrid[: SHAPE[0], : SHAPE[1]][::-1].astype(np.float64), 0, -1), 6, 5)[2]
    bare, surrounded = (model(border_lenslets=count).irradiance(ON_AXIS) for count in (0, border_lenslets))
    np.testing.assert_allclose(surrounded[inside], bare[inside], rtol=1e-5, atol=1e-9)
    assert surrounded[~inside].max() > 0.5 * bare.max()
    assert not bare[~inside].any()


def test_truth_is_the_screen_at_the_centres() -> None:
    along_m: Floats = (np.arange(401, dtype=np.float64) - 200) * 10e-6
    screen = PhaseScreen(curved(along_m, along_m[:, None]), 10e-6)
    field = Field(collimator_focal_length_m=0.2, half_width_m=0.6e-3)
    rays = RayMap.near_pupil(distance_m=0.1, collimator_focal_length_m=0.2)
    truth = truth_wavefront(screen, rays, SENSOR, field, (20e-6, 0.0))
    centers_m: Floats = SENSOR.lenslet_centers_m + np.array([230e-6, -250e-6])
    expected = curved(centers_m[..., 0], centers_m[..., 1])  # view (2, 0)
    np.testing.assert_allclose(truth[2, 0], expected - expected.mean(), atol=1e-6)
