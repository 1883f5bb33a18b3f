"""Light through several layers, against one layer and against lenses in closed form."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from support.optics import FIELD, sensor_of

from reconstruction.arrays import Floats
from simulated_devices.optics.phase_screen import PhaseScreen, smooth_screen
from simulated_devices.optics.propagated_light import PropagatedLight
from simulated_devices.optics.screen_light import RayMap, truth_wavefront
from simulated_devices.sample import point_field
from studies.layered_light import LayeredLight, PlacedScreen

SENSOR = sensor_of(5, 7)
WAVENUMBER = 2 * math.pi / 462e-9
SPACING_M = 25e-6
SAMPLE_X_M, SAMPLE_Y_M = np.linspace(-1.75e-3, 1.75e-3, 71), np.linspace(-1.25e-3, 1.25e-3, 51)
OBJECT_M = (0.5e-3, -0.3e-3)


def rough(seed: int) -> PhaseScreen:
    generator = np.random.default_rng(seed)
    samples = smooth_screen(generator, samples=257, sample_spacing_m=SPACING_M, correlation_length_m=1e-3)
    return PhaseScreen(samples * (5.0 / samples.std()), SPACING_M)


def lens(curvature: float) -> PhaseScreen:
    along_m = (np.arange(257) - 128) * SPACING_M
    return PhaseScreen(curvature / 2 * (along_m**2 + along_m[:, None] ** 2), SPACING_M)


def light_of(*layers: PlacedScreen, neglect_propagation: bool = False) -> LayeredLight:
    field = replace(FIELD, neglect_propagation=neglect_propagation)
    return LayeredLight(layers, SENSOR, field, pupil_half_width_m=(1.75e-3, 1.25e-3))


def field_of(*layers: PlacedScreen) -> np.ndarray[tuple[int, ...], np.dtype[np.complex64]]:
    return light_of(*layers).field(SAMPLE_X_M, SAMPLE_Y_M)(*OBJECT_M)


@pytest.mark.parametrize("flat_at_m", [0.25, 0.08, 0.0, -0.1])
@pytest.mark.parametrize("distance_m", [0.195, -0.12])
def test_flat_layer_changes_nothing(distance_m: float, flat_at_m: float) -> None:
    screen, flat = rough(1), PhaseScreen(np.zeros((100, 100)), SPACING_M)
    rays = RayMap.near_pupil(distance_m=distance_m, collimator_focal_length_m=0.2)
    alone = PropagatedLight(
        screen,
        None,
        rays,
        half_width_m=screen.half_width_m,
        collimator_focal_length_m=0.2,
        wavenumber_rad_per_m=WAVENUMBER,
    )
    layers = (PlacedScreen(phase=screen, distance_m=distance_m), PlacedScreen(phase=flat, distance_m=flat_at_m))
    expected = point_field(alone, SAMPLE_X_M, SAMPLE_Y_M)(*OBJECT_M)
    ratio = field_of(*layers) / expected
    # The beam's tilt changes the path of the light by a constant.
    np.testing.assert_allclose(ratio * np.exp(-1j * np.angle(ratio.mean())), 1, atol=4e-3)
    truth = truth_wavefront(alone.phase, alone.ray_map, SENSOR, FIELD)
    np.testing.assert_allclose(light_of(*layers).wavefront(SENSOR, FIELD), truth, atol=4e-3)


def test_two_lenses_are_a_telescope() -> None:
    """Behind a lens with the curvature c, light over z has c / (1 + c z / k) and is stretched by 1 + c z / k."""
    (first, first_m), (second, second_m) = (-3e6, 0.22), (5e6, 0.06)
    screens = ((second, second_m), (first, first_m))
    light = light_of(*(PlacedScreen(phase=lens(bend), distance_m=place_m) for bend, place_m in screens))
    stretch_1 = 1 + first * (first_m - second_m) / WAVENUMBER
    bend = first / stretch_1 + second
    stretch_2 = 1 + bend * second_m / WAVENUMBER
    field = light.field(SAMPLE_X_M, SAMPLE_Y_M)(0.0, 0.0)
    np.testing.assert_allclose(np.abs(field) ** 2, (stretch_1 * stretch_2) ** -2, rtol=3e-3)
    centers_m = SENSOR.lenslet_centers_m
    expected = bend / stretch_2 / 2 * (centers_m**2).sum(axis=-1)
    np.testing.assert_allclose(light.wavefront(SENSOR, FIELD)[1, 1], expected - expected.mean(), atol=3e-3)
    # In the frame of the tilt of the view at x = 0.5 mm, the lenses are centred at (z / f1) x.
    center_1, center_2 = first_m / 0.2 * 0.5e-3, second_m / 0.2 * 0.5e-3
    slope = -(first / stretch_1 * center_1 + second * center_2) / stretch_2  # at u = 0
    slopes = np.diff(light.wavefront(SENSOR, FIELD), axis=3).mean(axis=(2, 3)) / 500e-6
    np.testing.assert_allclose(slopes[1], [-slope, 0, slope], rtol=5e-3, atol=1.0)


def test_far_layer_is_met_before_near_one() -> None:
    """The order of layers in the list does not matter, that in the beam does."""
    far, near = PlacedScreen(phase=rough(1), distance_m=0.25), PlacedScreen(phase=rough(2), distance_m=0.05)
    field = field_of(far, near)
    np.testing.assert_array_equal(field_of(near, far), field)
    swapped = field_of(replace(far, phase=near.phase), replace(near, phase=far.phase))
    assert np.abs(np.abs(swapped) - np.abs(field)).max() > 0.1


def test_phases_add_up_without_propagation() -> None:
    layers = PlacedScreen(phase=rough(1), distance_m=0.25), PlacedScreen(phase=rough(2), distance_m=-0.05)
    field = light_of(*layers, neglect_propagation=True).field(SAMPLE_X_M, SAMPLE_Y_M)(*OBJECT_M)

    def phase(layer: PlacedScreen) -> Floats:
        x_m, y_m = (at - layer.distance_m / 0.2 * o for at, o in zip((SAMPLE_X_M, SAMPLE_Y_M), OBJECT_M, strict=True))
        return layer.phase.at(x_m, y_m[:, None])

    np.testing.assert_allclose(field, np.exp(1j * (phase(layers[0]) + phase(layers[1]))), atol=1e-3)


def test_sample_needs_a_layer() -> None:
    with pytest.raises(ValueError, match="at least one layer"):
        light_of()
