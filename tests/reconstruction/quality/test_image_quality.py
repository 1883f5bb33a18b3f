"""Point-spread function and modulation transfer against closed forms: sinc, Airy, Fresnel integrals."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import fresnel, j1
from support.optics import sensor_of

from reconstruction.arrays import Floats
from reconstruction.geometry import Sensor
from reconstruction.quality.image_quality import diffraction_rad, extrapolate, mtf, psf, psf_angles_rad, psf_reach_rad

SENSOR = sensor_of(9, 15)  # wider than high, so that x is not y
WIDTH_M, HEIGHT_M = 15 * 500e-6, 9 * 500e-6
LIMIT_RAD = SENSOR.wavelength_m / WIDTH_M


def pupil(sensor: Sensor = SENSOR) -> tuple[Floats, Floats]:
    """Lenslet centres in metres, (1, lenslet_column) and (lenslet_row, 1)."""
    return sensor.pupil_x_m[None, :], sensor.pupil_y_m[:, None]


def flat(sensor: Sensor = SENSOR) -> Floats:
    return np.zeros(sensor.lenslets)


def aberrated(seed: int = 3) -> Floats:
    """A strong, smooth, asymmetric phase."""
    u, v = pupil()
    a, b, c, d, e = np.random.default_rng(seed).normal(0, 3, 5)
    u, v = u / WIDTH_M * 2, v / HEIGHT_M * 2
    return np.asarray(a * u * u + b * u * v + c * v * v + d * u**3 + e * u * v * v + 2 * u - v)


def test_psf_of_flat_pupil_is_sinc() -> None:
    angle_rad = np.linspace(-4, 4, 81) * LIMIT_RAD
    seen = psf(flat(), SENSOR, angle_rad=angle_rad)
    along_x, along_y = (np.sinc(angle_rad * width_m / SENSOR.wavelength_m) for width_m in (WIDTH_M, HEIGHT_M))
    np.testing.assert_allclose(seen, np.outer(along_y**2, along_x**2), atol=3e-4)
    assert seen[40, 40] == pytest.approx(1, abs=1e-6)
    assert seen[40, 50] < 1e-6  # the first zero, at wavelength / width
    assert seen[50, 40] > 0.05  # and not yet along y, where the pupil is narrower
    assert diffraction_rad(SENSOR) == pytest.approx(LIMIT_RAD)


def test_mtf_of_flat_pupil_is_triangle() -> None:
    curves = mtf(flat(), SENSOR)
    for frequency_per_rad, transfer, limit, width_m in (
        (curves.frequency_x_per_rad, curves.along_x, curves.limit_x, WIDTH_M),
        (curves.frequency_y_per_rad, curves.along_y, curves.limit_y, HEIGHT_M),
    ):
        cutoff_per_rad = width_m / SENSOR.wavelength_m
        assert frequency_per_rad[0] == 0
        assert frequency_per_rad[-1] == pytest.approx(cutoff_per_rad)
        np.testing.assert_allclose(transfer, 1 - frequency_per_rad / cutoff_per_rad, atol=1e-6)
        np.testing.assert_allclose(limit, transfer)


def test_psf_of_circular_pupil_is_airy_pattern() -> None:
    sensor = sensor_of(61, 61)
    u, v = pupil(sensor)
    radius_m = 30.5 * sensor.lenslet_pitch_m
    phase = np.where(np.hypot(u, v) <= radius_m, 0.0, np.nan)
    angle_rad = np.linspace(0.05, 3, 60) * sensor.wavelength_m / (2 * radius_m)
    seen = psf(phase, sensor, angle_rad=np.append(0.0, angle_rad))
    x = sensor.wavenumber_rad_per_m * radius_m * angle_rad
    np.testing.assert_allclose(seen[0, 1:], (2 * j1(x) / x) ** 2, atol=4e-3)
    np.testing.assert_allclose(seen[1:, 0], (2 * j1(x) / x) ** 2, atol=4e-3)


def test_tilt_moves_psf_towards_positive_slope() -> None:
    u, v = pupil()
    slope_x, slope_y = 4 * 2 * np.pi / WIDTH_M, -2 * 2 * np.pi / WIDTH_M  # rad/m
    angle_rad = np.linspace(-8, 8, 17) * LIMIT_RAD
    seen = psf(slope_x * u + slope_y * v, SENSOR, angle_rad=angle_rad)
    assert seen[8 - 2, 8 + 4] == seen.max() == pytest.approx(1, abs=1e-5)
    tilted, straight = mtf(slope_x * u + slope_y * v + aberrated(), SENSOR), mtf(aberrated(), SENSOR)
    np.testing.assert_allclose(tilted.along_x, straight.along_x, atol=1e-5)
    np.testing.assert_allclose(tilted.along_y, straight.along_y, atol=1e-5)


@pytest.mark.parametrize("strength_rad", [-2.0, 7.0, 13.0])
def test_strehl_ratio_of_defocus_matches_fresnel_integrals(strength_rad: float) -> None:
    u, v = pupil()
    phase = strength_rad * ((2 * u / WIDTH_M) ** 2 + (2 * v / HEIGHT_M) ** 2)  # strength at each edge's middle
    x = np.sqrt(2 * abs(strength_rad) / np.pi)
    sine, cosine = fresnel(x)
    expected = ((sine**2 + cosine**2) / x**2) ** 2
    seen = psf(phase, SENSOR, angle_rad=np.zeros(1))[0, 0]
    assert seen == pytest.approx(expected, rel=0.02)  # 6 samples across a lenslet instead of an integral


def test_mtf_of_defocus_matches_closed_form() -> None:
    u, _ = pupil()
    strength_rad = 9.0
    curves = mtf(strength_rad * (2 * u / WIDTH_M) ** 2 + 0 * flat(), SENSOR)
    shift = 2 * curves.frequency_x_per_rad[1:] * SENSOR.wavelength_m / WIDTH_M  # in half widths, 0 ... 2
    expected = np.sin(2 * strength_rad * shift * (1 - shift / 2)) / (2 * strength_rad * shift)
    np.testing.assert_allclose(curves.along_x[1:], np.abs(expected), atol=3e-3)
    np.testing.assert_allclose(curves.along_y, curves.limit_y, atol=1e-5)


def test_psf_conserves_energy_for_any_phase() -> None:
    samples = 15 * 6
    period_rad = 6 * SENSOR.wavelength_m / SENSOR.lenslet_pitch_m
    angle_rad = np.arange(samples) / samples * period_rad
    phase = np.stack([aberrated(1), aberrated(2)])
    phase[1, 2, 3] = np.nan
    seen = psf(phase, SENSOR, angle_rad=angle_rad)
    light = seen.sum(axis=(1, 2)) * (1, (135 - 1) / 135)  # the peak is the square of the area
    np.testing.assert_allclose(light, 15 / 9, rtol=1e-4)  # a step is one wavelength over the width, also along y


def test_only_known_lenslets_transmit() -> None:
    phase = flat()
    phase[:, :10] = np.nan  # 5 of 15 columns remain
    angle_rad = np.array([0.0, 1.5, 3.0]) * LIMIT_RAD
    seen = psf(phase, SENSOR, angle_rad=angle_rad)[0]
    np.testing.assert_allclose(seen, np.sinc(angle_rad * WIDTH_M / 3 / SENSOR.wavelength_m) ** 2, atol=1e-3)
    curves = mtf(phase, SENSOR)
    third = curves.frequency_x_per_rad >= curves.frequency_x_per_rad[-1] / 3
    assert np.all(curves.limit_x[third] < 1e-6)
    np.testing.assert_allclose(curves.limit_y, mtf(flat(), SENSOR).limit_y, atol=1e-6)


def test_lost_lenslets_do_not_change_neighbouring_phase() -> None:
    u, v = pupil()
    bowl = 5 * ((2 * u / WIDTH_M) ** 2 + u * v / WIDTH_M**2)
    step = SENSOR.lenslet_pitch_m
    u, v = (
        np.linspace(u.min() - step, u.max() + step, 17)[None],
        np.linspace(v.min() - step, v.max() + step, 11)[:, None],
    )
    whole = 5 * ((2 * u / WIDTH_M) ** 2 + u * v / WIDTH_M**2)
    bowl[3:5, 4:8] = bowl[0, 0] = bowl[:, -1] = np.nan
    np.testing.assert_allclose(extrapolate(bowl), whole, atol=1e-4)


def test_psf_is_nan_without_lenslets_and_defined_for_one() -> None:
    phase = np.full((2, 9, 15), np.nan)
    phase[1, 4, 5] = 0.7
    before = phase.copy()
    angle_rad = np.array([0.0, 7.5]) * LIMIT_RAD
    seen, curves = psf(phase, SENSOR, angle_rad=angle_rad), mtf(phase, SENSOR)
    assert np.isnan(seen[0]).all()
    assert np.isnan(curves.along_x[0]).all()
    np.testing.assert_allclose(seen[1, 0], np.sinc(np.array([0, 0.5])) ** 2, atol=0.01)  # of 6 samples
    np.testing.assert_array_equal(phase, before)


def test_reach_contains_nearly_all_light() -> None:
    phase = np.stack([aberrated(1), aberrated(2), np.full((9, 15), np.nan)])
    reach_rad = psf_reach_rad(phase, SENSOR)
    step_rad = LIMIT_RAD / 2
    steps = int(reach_rad / step_rad)
    seen = psf(phase[:2], SENSOR, angle_rad=np.linspace(-steps, steps, 2 * steps + 1) * step_rad)
    assert np.all(seen.sum(axis=(1, 2)) / 4 > 0.9 * 15 / 9)
    assert 4 < reach_rad / LIMIT_RAD < 25
    assert np.isnan(psf_reach_rad(phase[2], SENSOR))


def test_psf_angles_are_centred_fine_and_limited() -> None:
    angle_rad = psf_angles_rad(SENSOR, 7.9 * LIMIT_RAD)
    assert angle_rad.size == 65
    assert angle_rad[32] == 0
    np.testing.assert_allclose(angle_rad[[0, -1]], [-7.9 * LIMIT_RAD, 7.9 * LIMIT_RAD])
    assert psf_angles_rad(SENSOR, 1000 * LIMIT_RAD).size == 201
