"""Light of several wavelengths: its settings, and its images beside those of each wavelength alone."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from app.acquisition.devices import scene_of, simulated_bench
from app.bench.config import Bench, load_bench, parse_bench, write_bench
from app.errors import InputError
from app.evaluation.frames import NoiseFreeFrames, with_screen
from reconstruction.annotated_settings import SettingError
from simulated_devices.clock import ManualClock
from simulated_devices.rendering import Renderer
from simulated_devices.settings import SimulatedLightSettings

NOMINAL_M = 462e-9
LINES_M, WEIGHTS = (440e-9, 470e-9), (4.0, 11.0)  # mean 462 nm


@pytest.fixture
def bench(small_toml: Path) -> Bench:
    return load_bench(small_toml)


def broad(bench: Bench) -> Bench:
    return replace(bench, light=replace(bench.light_model, wavelengths_m=LINES_M, weights=WEIGHTS))


def test_shares_are_normalised_and_dark_lines_left_out() -> None:
    assert SimulatedLightSettings().lines == ()
    even = SimulatedLightSettings(wavelengths_m=(4e-7, 5e-7)).lines
    assert even == ((4e-7, 0.5), (5e-7, 0.5))
    uneven = SimulatedLightSettings(wavelengths_m=(4e-7, 5e-7, 6e-7), weights=(3.0, 0.0, 1.0)).lines
    assert uneven == ((4e-7, 0.75), (6e-7, 0.25))


@pytest.mark.parametrize(
    ("wavelengths_m", "weights", "why"),
    [
        ((4e-7, 5e-7), (1.0,), "weights must be as many as wavelengths_m, 2"),
        ((), (1.0,), "weights must be as many as wavelengths_m, 0"),
        ((4e-7, 5e-7), (0.0, 0.0), "weights must not all be 0"),
    ],
)
def test_impossible_spectra_are_refused(wavelengths_m: tuple[float, ...], weights: tuple[float, ...], why: str) -> None:
    with pytest.raises(SettingError, match=why):
        SimulatedLightSettings(wavelengths_m=wavelengths_m, weights=weights)


def test_bench_file_holds_a_spectrum_about_its_wavelength(bench: Bench, small_toml: Path) -> None:
    assert parse_bench(write_bench(broad(bench)), "a bench") == broad(bench)
    with pytest.raises(InputError, match=r"light\.wavelengths_m have the mean 4\.7e-07, more than 1 % from sensor"):
        load_bench(small_toml, ("light.wavelengths_m=[460e-9, 480e-9]",))
    with pytest.raises(InputError, match=r"light\.weights must be as many"):
        load_bench(small_toml, ("light.wavelengths_m=[462e-9]", "light.weights=[1, 1]"))


def test_images_of_the_lines_add_up(bench: Bench) -> None:
    """Each line alone is a bench of its wavelength whose screen delays light by the same path."""
    renderer = Renderer(scene_of(broad(bench)))
    total = dict.fromkeys(("reference", "state"), np.zeros(()))
    for length_m, weight in zip(LINES_M, WEIGHTS, strict=True):
        sensor = replace(bench.sensor, wavelength_m=length_m)
        screen_rad = bench.simulation.screen.rms_rad * NOMINAL_M / length_m
        alone = Renderer(scene_of(with_screen(replace(bench, sensor=sensor), rms_rad=screen_rad)))
        total["reference"] = total["reference"] + weight / 15 * alone.reference("square")
        total["state"] = total["state"] + weight / 15 * alone.state("square", 0)
    nominal = Renderer(scene_of(bench))
    for image, sum_of_lines, of_nominal in (
        (renderer.reference("square"), total["reference"], nominal.reference("square")),
        (renderer.state("square", 0), total["state"], nominal.state("square", 0)),
    ):
        np.testing.assert_allclose(image, sum_of_lines, atol=1e-5 * image.max())
        assert np.abs(image - of_nominal).max() > 1e-3 * image.max()
        assert image.sum() == pytest.approx(of_nominal.sum(), rel=5e-3)
    np.testing.assert_array_equal(renderer.truth_wavefront(0), nominal.truth_wavefront(0))


def test_files_of_screens_are_phases_at_the_nominal_wavelength(bench: Bench, tmp_path: Path) -> None:
    generated = Renderer(scene_of(broad(bench)))
    file = tmp_path / "screen.npy"
    np.save(file, generated.sample.screen.samples_rad)
    with_file = replace(with_screen(broad(bench), file=str(file)), field=replace(bench.field, neglect_propagation=True))
    read, made = (Renderer(scene_of(each)).state("square", 0) for each in (with_file, with_screen(with_file, file="")))
    np.testing.assert_allclose(read, made, atol=1e-5 * made.max())


def test_simulated_devices_see_the_spectrum(bench: Bench) -> None:
    live = simulated_bench(broad(bench), lambda _: None, ManualClock())
    try:
        np.testing.assert_array_equal(live.references["square"], Renderer(live._scene).reference("square"))
        assert live._scene.lines == ((LINES_M[0], 4 / 15), (LINES_M[1], 11 / 15))
    finally:
        live.close()
    photons = NoiseFreeFrames(broad(bench)).reference()
    assert np.abs(photons / photons.max() - NoiseFreeFrames(bench).reference() / photons.max()).max() > 1e-3
