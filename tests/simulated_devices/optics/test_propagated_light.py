"""Light of a screen at the lenslets, against closed forms, Fresnel integrals and ray optics."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from reconstruction.arrays import Floats
from simulated_devices.optics.phase_screen import PhaseScreen, smooth_screen
from simulated_devices.optics.propagated_light import PropagatedLight, Propagation, unwrapped_phase
from simulated_devices.optics.screen_light import RayMap, ScreenLight
from simulated_devices.sample import point_field

WAVENUMBER = 2 * math.pi / 462e-9
FOCAL_LENGTH_M = 0.2
DISTANCE_M = 0.195
SPACING_M = 25e-6
NEAR_PUPIL = RayMap.near_pupil(distance_m=DISTANCE_M, collimator_focal_length_m=FOCAL_LENGTH_M)
ALONG_M = np.linspace(-2e-3, 2e-3, 41)


def light_of(
    screen: PhaseScreen, rays: RayMap = NEAR_PUPIL, amplitude: PhaseScreen | None = None, used_m: float = 3.5e-3
) -> PropagatedLight:
    return PropagatedLight(
        screen,
        amplitude,
        rays,
        half_width_m=(used_m, used_m),
        collimator_focal_length_m=FOCAL_LENGTH_M,
        wavenumber_rad_per_m=WAVENUMBER,
    )


def on_grid(samples: int = 385, spacing_m: float = SPACING_M) -> tuple[Floats, Floats]:
    """Positions x and y of a screen's samples, (row, column)."""
    along_m = (np.arange(samples) - (samples - 1) / 2) * spacing_m
    x_m, y_m = np.meshgrid(along_m, along_m)
    return np.asarray(x_m), np.asarray(y_m)


def lens(curvature: float) -> PhaseScreen:
    x, y = on_grid()
    return PhaseScreen(curvature / 2 * (x**2 + y**2), SPACING_M)


def rough(seed: int = 1, length_m: float = 2e-3, rms_rad: float = 12.0) -> PhaseScreen:
    generator = np.random.default_rng(seed)
    samples = smooth_screen(generator, samples=385, sample_spacing_m=SPACING_M, correlation_length_m=length_m)
    return PhaseScreen(samples * (rms_rad / samples.std()), SPACING_M)


def wavy(x_m: Floats) -> Floats:
    return np.asarray(3 * np.sin(1800 * x_m + 0.4) + 2 * np.cos(900 * x_m), np.float64)


@pytest.mark.parametrize("curvature", [4e6, -4e6])
@pytest.mark.parametrize("sign", [1, -1])
def test_lens_gathers_light_and_changes_its_curvature(curvature: float, sign: int) -> None:
    """c < 0 converges behind the screen: intensity 1 / (1 + c z / k)^2, curvature c / (1 + c z / k)."""
    rays = RayMap.near_pupil(distance_m=sign * DISTANCE_M, collimator_focal_length_m=FOCAL_LENGTH_M)
    light = light_of(lens(curvature), rays)
    stretch = 1 + curvature * sign * DISTANCE_M / WAVENUMBER
    assert abs(stretch - 1) > 0.05
    intensity = np.abs(light.at(ALONG_M, ALONG_M[:, None])) ** 2
    np.testing.assert_allclose(intensity, 1 / stretch**2, rtol=2e-3)
    phase = light.phase.at(ALONG_M, ALONG_M[:, None])
    expected = curvature / stretch / 2 * (ALONG_M**2 + ALONG_M[:, None] ** 2)
    np.testing.assert_allclose(phase - phase[20, 20], expected, atol=2e-3)


def test_screen_wider_than_high_is_propagated_over_its_whole_width() -> None:
    """A cylindrical lens in x: intensity 1 / (1 + c z / k), curvature c / (1 + c z / k)."""
    curvature = 4e6
    x_m = np.arange(-192, 193) * SPACING_M
    screen = PhaseScreen(np.tile(curvature / 2 * x_m**2, (129, 1)), SPACING_M)
    light = PropagatedLight(
        screen,
        None,
        NEAR_PUPIL,
        half_width_m=(4.5e-3, 1e-3),
        collimator_focal_length_m=FOCAL_LENGTH_M,
        wavenumber_rad_per_m=WAVENUMBER,
    )
    stretch = 1 + curvature * DISTANCE_M / WAVENUMBER
    wide_m, high_m = np.linspace(-4.4e-3, 4.4e-3, 89), np.linspace(-0.9e-3, 0.9e-3, 7)[:, None]
    np.testing.assert_allclose(np.abs(light.at(wide_m, high_m)) ** 2, 1 / stretch, rtol=2e-3)
    phase = light.phase.at(wide_m, high_m)
    expected = np.broadcast_to(curvature / stretch / 2 * wide_m**2, phase.shape)
    np.testing.assert_allclose(phase - phase[3, 44], expected, atol=2e-3)


@pytest.mark.slow
@pytest.mark.long
def test_lens_near_the_mask_gathers_light_on_its_way_to_the_collimator() -> None:
    """A ray at the angle t meets the screen at d t and the collimator at f1 t + (f1 - d) c d t / k."""
    d, curvature = 0.05, 2e8
    rays = RayMap.near_source(distance_m=d, collimator_focal_length_m=FOCAL_LENGTH_M)
    assert rays.ratio == pytest.approx(-3)
    assert rays.propagation_m(FOCAL_LENGTH_M) == pytest.approx(0.6)
    x, y = on_grid(641, 5e-6)
    light = light_of(PhaseScreen(curvature / 2 * (x**2 + y**2), 5e-6), rays, used_m=1e-3)
    stretch = 1 + (FOCAL_LENGTH_M - d) * d * curvature / (WAVENUMBER * FOCAL_LENGTH_M)
    assert stretch > 1.5
    np.testing.assert_allclose(np.abs(light.at(ALONG_M, ALONG_M[:, None])) ** 2, 1 / stretch**2, rtol=3e-3)
    phase = light.phase.at(ALONG_M, 0.0)
    # Behind the collimator the ray's angle is c d^2 t / (k f1).
    expected = curvature * (d / FOCAL_LENGTH_M) ** 2 / stretch / 2 * ALONG_M**2
    np.testing.assert_allclose(phase - phase[20], expected, atol=3e-3)


def fresnel_integral(
    phase: NDArray[np.float64], s_m: Floats, u_m: Floats, tilt_rad_per_m: float
) -> NDArray[np.complex128]:
    """Field at u of the field exp(i (phase + tilt s)) at s, by the sum of its Fresnel integral along one axis."""
    edge = np.clip((np.abs(s_m).max() - np.abs(s_m)) / 2e-3, 0, 1)
    source = np.exp(1j * (phase + tilt_rad_per_m * s_m)) * np.sin(np.pi / 2 * edge) ** 2
    kernel = np.exp(0.5j * WAVENUMBER / DISTANCE_M * (u_m[:, None] - s_m) ** 2)
    step_m = s_m[1] - s_m[0]
    return np.asarray(kernel @ source * step_m * np.sqrt(WAVENUMBER / (2j * math.pi * DISTANCE_M)), np.complex128)


@pytest.mark.parametrize("object_m", [(0.0, 0.0), (0.5e-3, -0.35e-3)])
def test_field_of_an_object_point_is_its_fresnel_integral(object_m: tuple[float, float]) -> None:
    """The light of an object point imaged at +x has the tilt k x / f1 at the screen and behind it."""
    x, y = on_grid()
    light = light_of(PhaseScreen(wavy(x) + wavy(-y), SPACING_M), used_m=4.5e-3)
    u_m, s_m = np.linspace(-1.5e-3, 1.5e-3, 25), np.linspace(-8e-3, 8e-3, 16001)
    expected = []
    for at_m, sign in zip(object_m, (1, -1), strict=True):
        tilt = WAVENUMBER * at_m / FOCAL_LENGTH_M
        expected.append(fresnel_integral(wavy(sign * s_m), s_m, u_m, tilt) * np.exp(-1j * tilt * u_m))
    field = point_field(light, u_m, u_m)(*object_m)
    ratio = field / np.outer(expected[1], expected[0])
    np.testing.assert_allclose(ratio / (ratio.mean() / abs(ratio.mean())), 1, atol=3e-3)
    assert np.std(np.abs(field) ** 2) > 0.1  # it scintillates
    assert abs(abs(ratio.mean()) - 1) < 1e-3


WAVES = np.random.default_rng(5).normal(size=(12, 2)) * 1200  # rad/m, (wave, xy)
STRENGTHS = np.random.default_rng(6).normal(size=12) * 1.2  # rad


def waves(x_m: Floats, y_m: Floats, order_x: int = 0, order_y: int = 0) -> Floats:
    """Sum of plane waves, or its derivative."""
    angle = np.multiply.outer(WAVES[:, 0], x_m) + np.multiply.outer(WAVES[:, 1], y_m)
    strength = STRENGTHS * WAVES[:, 0] ** order_x * WAVES[:, 1] ** order_y
    return np.asarray(np.tensordot(strength, np.cos(angle + (order_x + order_y) * math.pi / 2), axes=1))


def test_intensity_is_van_vlecks_determinant() -> None:
    """Ray optics: light at s arrives at s + z grad Phi / k, with the intensity 1 / det(1 + z Phi'' / k).

    Diffraction changes it by about (z q^2 / 2k)^2 / 6, at most 2e-3 for these waves.
    """
    x, y = np.meshgrid(np.linspace(-2.5e-3, 2.5e-3, 61), np.linspace(-2.5e-3, 2.5e-3, 61))
    along = DISTANCE_M / WAVENUMBER
    xx, yy, xy = (along * waves(x, y, *orders) for orders in ((2, 0), (0, 2), (1, 1)))
    expected = 1 / ((1 + xx) * (1 + yy) - xy**2)
    light = light_of(PhaseScreen(waves(*on_grid()), SPACING_M))
    found = np.abs(light.at(x + along * waves(x, y, 1, 0), y + along * waves(x, y, 0, 1))) ** 2
    assert expected.std() > 0.15
    np.testing.assert_allclose(found, expected, rtol=1e-3)


def test_light_keeps_its_energy_and_comes_back() -> None:
    generator = np.random.default_rng(3)
    field = generator.normal(size=(60, 72)) + 1j * generator.normal(size=(60, 72))
    forth, back = (Propagation(distance_m=way_m, wavenumber_rad_per_m=WAVENUMBER) for way_m in (0.3, -0.3))
    there = forth(field, sample_spacing_m=SPACING_M)
    assert np.abs(there - field).max() > 0.5
    assert np.sum(np.abs(there) ** 2) == pytest.approx(np.sum(np.abs(field) ** 2), rel=1e-12)
    np.testing.assert_allclose(back(there, sample_spacing_m=SPACING_M), field, atol=1e-12)


def test_positive_slope_moves_light_to_positive_x() -> None:
    slope, (x, y) = 8e3, on_grid()
    spot = PhaseScreen(0.2 + np.exp(-(x**2 + y**2) / (2 * 0.4e-3**2)), SPACING_M)
    light = light_of(PhaseScreen(slope * x, SPACING_M), amplitude=spot)
    along_m = np.linspace(-2e-3, 2e-3, 801)
    intensity = np.abs(light.at(along_m, 0.0)) ** 2
    moved_m = float(np.sum(along_m * (intensity - 0.04)) / np.sum(intensity - 0.04))
    assert moved_m == pytest.approx(slope / WAVENUMBER * DISTANCE_M, rel=0.02)


def test_moved_screen_shifts_its_light() -> None:
    shift_m = (0.12e-3, -0.3e-3)
    x, y = on_grid()
    light, moved = (
        light_of(PhaseScreen(wavy(x - at_x) + wavy(-(y - at_y)), SPACING_M)) for at_x, at_y in ((0.0, 0.0), shift_m)
    )
    field = point_field(light, ALONG_M, ALONG_M, shift_m)(0.4e-3, 0.1e-3)
    expected = point_field(moved, ALONG_M, ALONG_M)(0.4e-3, 0.1e-3)
    np.testing.assert_allclose(field, expected, atol=3e-3)
    assert np.abs(field - point_field(light, ALONG_M, ALONG_M)(0.4e-3, 0.1e-3)).max() > 0.5


def test_steep_phase_is_sampled_finely_enough() -> None:
    """A screen of 1.5 rad a sample against the same one sampled five times as finely."""
    steep = 1.5 / SPACING_M

    def light(spacing_m: float, samples: int) -> PropagatedLight:
        x, _ = on_grid(samples, spacing_m)
        return light_of(PhaseScreen(steep / 1e3 * np.sin(1e3 * x), spacing_m), used_m=2.5e-3)

    between_m = ALONG_M * 0.987 + 7e-6  # samples themselves are always right
    coarse, fine = (one.at(between_m, 0.0) for one in (light(SPACING_M, 385), light(SPACING_M / 5, 1921)))
    np.testing.assert_allclose(coarse, fine, atol=5e-3)


def test_without_propagation_light_is_uniform_with_the_phase_of_the_screen() -> None:
    screen = rough()
    light = ScreenLight(screen, None, NEAR_PUPIL)
    field = point_field(light, ALONG_M, ALONG_M)(0.3e-3, -0.5e-3)
    np.testing.assert_allclose(np.abs(field), 1, atol=1e-6)
    expected = screen.at(ALONG_M - 0.975 * 0.3e-3, ALONG_M[:, None] + 0.975 * 0.5e-3)
    np.testing.assert_allclose(field, np.exp(1j * expected), atol=2e-5)


def test_mask_plane_sends_no_light_on() -> None:
    at_mask = RayMap.near_source(distance_m=0.0, collimator_focal_length_m=FOCAL_LENGTH_M)
    with pytest.raises(ValueError, match=r"^distance_m must be positive"):
        light_of(rough(), at_mask)


def test_light_of_too_rough_a_screen_is_refused() -> None:
    with pytest.raises(ValueError, match=r"^rms_rad must be smaller, or correlation_length_m larger"):
        light_of(rough(rms_rad=1e4))


def test_unwrapped_phase_has_no_jumps() -> None:
    x, y = np.meshgrid(np.linspace(-1, 1, 90), np.linspace(-1, 1, 70))
    phase = 20 * x**2 - 12 * y**3 + 15 * x * y + 6 * np.sin(4 * x)
    assert np.ptp(phase) > 15 * math.pi
    field = (1 + 0.3 * np.cos(5 * y)) * np.exp(1j * phase)
    difference = unwrapped_phase(field) - phase
    turns = difference / (2 * math.pi)
    np.testing.assert_allclose(turns, np.round(turns[0, 0]), atol=1e-9)


def test_unwrapped_phase_is_that_of_the_field_even_around_dark_points() -> None:
    x, y = np.meshgrid(np.linspace(-1, 1, 64), np.linspace(-1, 1, 48))
    field = (x - 0.31 + 1j * (y - 0.17)) * (x + 0.42 - 1j * (y + 0.23)) * np.exp(8j * x)
    np.testing.assert_allclose(np.exp(1j * unwrapped_phase(field)), field / np.abs(field), atol=1e-9)
