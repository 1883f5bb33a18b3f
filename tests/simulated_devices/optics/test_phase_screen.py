"""Phase screens: the ensemble's recipe, splines, scaling, files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile
from scipy import ndimage
from scipy.interpolate import RectBivariateSpline
from support.optics import FIELD, sensor_of

from app.bench.config import load_bench
from simulated_devices.optics.phase_screen import PhaseScreen, read_screen, shape_to_pv_and_rms, smooth_screen
from simulated_devices.optics.screen_light import truth_wavefront
from simulated_devices.sample import make_sample, mean_view_rms, ray_map, screen_size, shift_m
from simulated_devices.settings import Screen, Simulation

SENSOR = sensor_of(15, 15)


def quick(samples: int = 120, seed: int = 0) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    generator = np.random.default_rng(seed)
    return smooth_screen(generator, samples=samples, sample_spacing_m=25e-6, correlation_length_m=0.3e-3)


@pytest.mark.parametrize("length_m", [1.25e-3, 1.6e-3, 2.0e-3])
def test_smooth_screen_is_the_ensemble_bit_for_bit(length_m: float) -> None:
    n, p = 385, int(4 * length_m / 25e-6)
    noise = np.random.default_rng(2).standard_normal((n + 2 * p, n + 2 * p))
    expected = ndimage.gaussian_filter(noise, length_m / 25e-6)[p : p + n, p : p + n]
    expected = expected - expected.mean()
    generator = np.random.default_rng(2)
    screen = smooth_screen(generator, samples=n, sample_spacing_m=25e-6, correlation_length_m=length_m)
    np.testing.assert_array_equal(screen, expected)


def test_paper_sample_has_requested_mean_rms_over_views() -> None:
    sample = make_sample(Simulation(seed=1), SENSOR, FIELD)
    assert sample.screen.samples_rad.shape == (385, 385)
    n, p = 385, 320
    noise = np.random.default_rng(1).standard_normal((n + 2 * p, n + 2 * p))
    raw = ndimage.gaussian_filter(noise, 80.0)[p:-p, p:-p]
    axis = (np.arange(n) - 192) * 25e-6
    spline = RectBivariateSpline(axis, axis, raw - raw.mean())
    u = (np.arange(15) - 7) * 0.5e-3
    views = np.array([[spline(u - 0.975 * y, u - 0.975 * x) for x in (-5e-4, 0, 5e-4)] for y in (-5e-4, 0, 5e-4)])
    rms = views.std(axis=(2, 3))
    expected = views * (4.2 / rms.mean())
    expected -= expected.mean(axis=(2, 3), keepdims=True)
    found = truth_wavefront(sample.screen, sample.ray_map, SENSOR, FIELD)
    np.testing.assert_allclose(found, expected, atol=1e-9)


def assert_is_of_the_ensemble(
    simulation: Simulation, *, samples: int, spacing_m: float, rms_rad: float, pupil_scale: float, field_scale: float
) -> None:
    """Compare with the recipe of the project's ensembles, written out step by step."""
    length_m = simulation.screen.correlation_length_m
    n, p = samples, int(4 * length_m / spacing_m)
    noise = np.random.default_rng(simulation.seed).standard_normal((n + 2 * p, n + 2 * p))
    raw = ndimage.gaussian_filter(noise, length_m / spacing_m)[p : p + n, p : p + n]
    raw = raw - raw.mean()
    axis = (np.arange(n) - (n - 1) / 2) * spacing_m
    spline = RectBivariateSpline(axis, axis, raw)
    u = (np.arange(15) - 7) * 0.5e-3
    rms = [
        spline(pupil_scale * u + field_scale * y, pupil_scale * u + field_scale * x).std()
        for y in (-5e-4, 0.0, 5e-4)
        for x in (-5e-4, 0.0, 5e-4)
    ]
    sample = make_sample(simulation, SENSOR, FIELD)
    scale = rms_rad / mean_view_rms(truth_wavefront(PhaseScreen(raw, spacing_m), sample.ray_map, SENSOR, FIELD))
    assert scale == pytest.approx(rms_rad / np.mean(rms), rel=1e-12)  # a mean's last bit is a matter of its order
    np.testing.assert_array_equal(sample.screen.samples_rad, raw * scale)


@pytest.mark.slow
# 4 sigma of the last is no whole number of samples: its edge is that of a screen that was not enlarged.
@pytest.mark.parametrize(("length_m", "seed"), [(1.25e-3, 1), (1.6e-3, 2), (2.0e-3, 3), (1.255e-3, 4)])
def test_samples_near_pupil_are_the_ensemble_bit_for_bit(length_m: float, seed: int) -> None:
    simulation = Simulation(seed=seed, screen=Screen(correlation_length_m=length_m))
    assert_is_of_the_ensemble(
        simulation, samples=385, spacing_m=25e-6, rms_rad=4.2, pupil_scale=1.0, field_scale=-0.975
    )


@pytest.mark.slow
def test_experiment_sample_is_the_ensemble_bit_for_bit() -> None:
    assert load_bench("paper_experiment").simulation.screen.correlation_length_m == 1.2e-3  # whose screen takes 20 s
    quicker = ("simulation.seed=2", "simulation.screen.correlation_length_m=0.3e-3")
    simulation = load_bench("paper_experiment", quicker).simulation
    rms_rad = simulation.screen.rms_rad  # how strong it is is the preset's own affair
    assert_is_of_the_ensemble(
        simulation, samples=481, spacing_m=5e-6, rms_rad=rms_rad, pupil_scale=0.1, field_scale=-0.9
    )


ENLARGED = {"border lenslets": Simulation(border_lenslets=2), "drift": Simulation(screen=Screen(drift_x_m_per_s=2e-4))}


@pytest.mark.slow
@pytest.mark.parametrize("enlarged", ENLARGED.values(), ids=ENLARGED)
@pytest.mark.parametrize("pv_rad", [None, 28.846])
def test_middle_of_enlarged_screen_is_the_screen(enlarged: Simulation, pv_rad: float | None) -> None:
    rms_rad = 4.2 if pv_rad is None else 5.712
    plain, large = (
        make_sample(
            replace(simulation, screen=replace(simulation.screen, pv_rad=pv_rad, rms_rad=rms_rad)), SENSOR, FIELD
        ).screen
        for simulation in (Simulation(), enlarged)
    )
    ring = (len(large.samples_rad) - 385) // 2
    assert ring > 10
    # The scale comes from the spline, which feels the ring by rounding.
    np.testing.assert_allclose(large.samples_rad[ring:-ring, ring:-ring], plain.samples_rad, rtol=1e-9, atol=1e-9)
    outside = large.samples_rad[:, :ring]
    assert 0.2 * plain.samples_rad.std() < outside.std() < 3 * plain.samples_rad.std()
    steps = np.abs(np.diff(large.samples_rad, axis=0)).max(axis=1)
    assert steps[ring - 3 : ring + 3].max() <= steps.max()  # no seam
    assert steps.max() < 0.5


def test_screen_is_interpolated_by_bicubic_spline() -> None:
    samples = quick()[:, :90]
    screen = PhaseScreen(samples, 25e-6)
    y, x = (np.arange(120) - 59.5) * 25e-6, (np.arange(90) - 44.5) * 25e-6
    generator = np.random.default_rng(4)
    at_x, at_y = generator.uniform(x[0], x[-1], 50), generator.uniform(y[0], y[-1], 50)
    np.testing.assert_allclose(screen.at(at_x, at_y), RectBivariateSpline(y, x, samples).ev(at_y, at_x), atol=1e-12)
    np.testing.assert_allclose(screen.at(x[3], y[7]), samples[7, 3], atol=1e-12)


def test_position_beside_the_screen_raises() -> None:
    screen = PhaseScreen(quick()[:, :90], 25e-6)
    screen.at(0.0, 1.4e-3)
    with pytest.raises(ValueError, match=r"at x = 1\.4 mm, but the screen ends at 1\.113 mm"):
        screen.at(1.4e-3, 0.0)
    with pytest.raises(ValueError, match="at y = "):
        screen.at(0.0, np.nan)


@pytest.mark.parametrize(("pv_rad", "rms_rad"), [(28.846, 5.712), (20.0, 5.712), (40.0, 4.0)])
def test_shaping_reaches_pv_and_rms(pv_rad: float, rms_rad: float) -> None:
    samples = quick(200, seed=1)
    shaped = shape_to_pv_and_rms(samples, pv_rad=pv_rad, rms_rad=rms_rad)
    assert np.ptp(shaped) == pytest.approx(pv_rad, rel=1e-9)
    assert shaped.std() == pytest.approx(rms_rad, rel=1e-9)
    assert shaped.mean() == pytest.approx(0.0, abs=1e-9)
    order = np.argsort(samples.ravel())
    assert (np.diff(shaped.ravel()[order]) >= 0).all()  # monotone: contours stay where they are


def test_impossible_pv_and_rms_are_refused() -> None:
    with pytest.raises(ValueError, match=r"pv_rad = 2.01 with rms_rad = 1 cannot be reached"):
        shape_to_pv_and_rms(quick(), pv_rad=2.01, rms_rad=1.0)


@pytest.mark.slow
def test_drift_enlarges_and_moves_the_screen() -> None:
    still = Simulation(border_lenslets=1)
    moving = Simulation(border_lenslets=1, screen=Screen(drift_x_m_per_s=2e-4, drift_y_m_per_s=-1e-4))
    assert shift_m(moving, 10) == pytest.approx((2e-4, -1e-4))
    need_m = 8.5 * 0.5e-3 + 0.975 * 0.6e-3
    assert make_sample(still, SENSOR, FIELD).screen.half_width_m[0] >= need_m
    assert make_sample(moving, SENSOR, FIELD).screen.half_width_m[0] >= need_m + 48 * 0.1 * 2e-4


def test_too_large_screen_is_refused() -> None:
    def drifting(drift_m_per_s: float) -> Simulation:
        return Simulation(screen=Screen(drift_y_m_per_s=-drift_m_per_s))

    field = replace(FIELD, neglect_propagation=True)  # else there is a guard around the footprint
    for drift_m_per_s in (10.0, 1e308):
        with pytest.raises(ValueError, match=r"^sample_spacing_m must be larger .* drift .* samples a side"):
            make_sample(drifting(drift_m_per_s), SENSOR, field)
    allowed = 0.995 * (8000 / 2 * 25e-6 - 8e-3 - 4.3e-3) / (48 * 0.1)
    rays = ray_map(Screen(), FIELD)
    size = screen_size(drifting(allowed), SENSOR, field, rays)
    assert 7900 < 385 + 2 * (size.enlarged_by + size.guard) + 2 * 320 <= 8000
    for screen in (Screen(sample_spacing_m=1e-9), Screen(correlation_length_m=10.0)):
        with pytest.raises(ValueError, match=r"^sample_spacing_m must be larger .* samples a side"):
            make_sample(Simulation(screen=screen), SENSOR, field)


def test_screens_are_read_from_files(tmp_path: Path) -> None:
    samples = quick(20)
    np.save(tmp_path / "screen.npy", samples)
    np.testing.assert_array_equal(read_screen(tmp_path / "screen.npy"), samples)
    tifffile.imwrite(tmp_path / "screen.tif", samples)
    np.testing.assert_array_equal(read_screen(tmp_path / "screen.tif"), samples)
    used = make_sample(Simulation(screen=Screen(file=str(tmp_path / "screen.npy"))), SENSOR, FIELD)
    np.testing.assert_array_equal(used.screen.samples_rad, samples)


def test_bad_file_raises_one_sentence(tmp_path: Path) -> None:
    for name, content in (("a.npy", b"no array"), ("b.tif", b"no image"), ("c.npy", b""), ("d.tif", b"II*\0")):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(ValueError, match=r"^file = .* is not a readable"):
            read_screen(tmp_path / name)
    with pytest.raises(ValueError, match=r"^file = .* is not a readable"):
        read_screen(tmp_path / "absent.npy")
    nan, none, complex_ = np.full((5, 5), np.nan), np.zeros((0, 5)), np.zeros((5, 5), complex)
    for name, array in (("1d.npy", np.zeros(5)), ("nan.npy", nan), ("none.npy", none), ("complex.npy", complex_)):
        np.save(tmp_path / name, array)
        with pytest.raises(ValueError, match=r"^file = .* must hold a 2-D array"):
            read_screen(tmp_path / name)
