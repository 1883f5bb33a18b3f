"""Images of imperfect benches, and the study of them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from app.acquisition.devices import scene_of
from app.bench.config import Bench, load_bench
from reconstruction.arrays import Floats, Image
from simulated_devices.rendering import Renderer
from studies.imperfect_bench import CASES, NONE, Imperfections, camera_of, detected, imperfect_bench, imperfect_images
from studies.tables import Asked

MASK = "checkerboard"


@pytest.fixture
def bench(small_toml: Path) -> Bench:
    return load_bench(small_toml, (f"simulation.source.mask='{MASK}'",))


def cells(image: Image, bench: Bench) -> Floats:
    """Pixels of every lenslet's cell, cut to whole pixels: (lenslet, pixel), and a column each for x and y."""
    sensor, lattice = bench.sensor, bench.design_lattice(*image.shape)
    row, column = np.indices(image.shape)
    position_px = np.stack([column, row], axis=-1).astype(np.float64)
    cell, local_px, inside = lattice.cells_at(position_px, sensor.lenslet_rows, sensor.lenslet_columns)
    lenslet = np.where(inside, cell[..., 1] * sensor.lenslet_columns + cell[..., 0], -1)
    count = sensor.lenslet_rows * sensor.lenslet_columns
    weights = (image, image * local_px[..., 0], image * local_px[..., 1])
    return np.array([np.bincount(lenslet[inside], each[inside], count) for each in weights])  # (sum and moments, ...)


def test_perfect_bench_has_the_images_of_the_simulated_bench(bench: Bench) -> None:
    ((reference, frame), truth), renderer = imperfect_images(bench, NONE), Renderer(scene_of(bench))
    assert reference == pytest.approx(renderer.reference(MASK), abs=1e-4 * float(reference.max()))
    assert frame == pytest.approx(renderer.state(MASK, 0), abs=1e-4 * float(frame.max()))
    assert np.array_equal(truth, renderer.truth_wavefront(0))


def test_lattice_moves_subimages(bench: Bench) -> None:
    light, *moments = cells(imperfect_images(bench, NONE)[0][0], bench)
    at_rest = np.array(moments) / light
    light, *moments = cells(imperfect_images(bench, Imperfections(lattice_px=0.3))[0][0], bench)
    assert np.std(np.array(moments) / light - at_rest) == pytest.approx(0.3, rel=0.25)  # of 70 numbers


def test_camera_out_of_focus_sees_larger_and_blurred_subimages(bench: Bench) -> None:
    (sharp, _), _ = imperfect_images(bench, NONE)
    farther = Imperfections(defocus=0.04)
    (blurred, _), _ = imperfect_images(bench, farther)
    told = replace(bench.sensor, lenslet_focal_length_m=1.04 * bench.sensor.lenslet_focal_length_m)
    (enlarged, _), _ = imperfect_images(replace(bench, sensor=told), NONE)
    assert blurred.max() < enlarged.max() < 1.02 * sharp.max()
    assert np.std(blurred - enlarged) < np.std(blurred - sharp)


def test_wavelengths_add_up(bench: Bench) -> None:
    (reference, _), _ = imperfect_images(bench, Imperfections(bandwidth_m=20e-9))
    lines = []
    for offset_m in (-20e-9, 0.0, 20e-9):
        sensor = replace(bench.sensor, wavelength_m=bench.sensor.wavelength_m + offset_m)
        lines.append(Renderer(scene_of(replace(bench, sensor=sensor))).reference(MASK))
    assert reference == pytest.approx(np.mean(lines, axis=0), abs=1e-4 * float(reference.max()))
    assert np.abs(lines[1] - reference).max() > 1e-3 * reference.max()


def test_absorption_changes_the_frame_alone(bench: Bench) -> None:
    (reference, frame), _ = imperfect_images(bench, NONE)
    (its_reference, its_frame), _ = imperfect_images(bench, Imperfections(absorption_rms=0.16))
    assert np.array_equal(its_reference, reference)
    assert 0.05 < np.std(its_frame - frame) / np.std(frame) < 0.5


def test_detector_loses_light() -> None:
    flat = np.full((80, 80), 2.0, np.float32)
    flat[:, 40:] = 1.0
    noisy, _ = detected((flat, flat), Imperfections(prnu=0.01), 1)
    assert np.std(noisy[:, 40:] / 0.5e5) == pytest.approx(0.01, rel=0.05)
    point = np.zeros((81, 81), np.float32)
    point[40, 40] = 1.0
    stray, _ = detected((point, point), Imperfections(stray_light=0.1), 1)
    assert stray[40, 40] == pytest.approx(0.9e5, rel=0.01)
    assert 0.05e5 < stray.sum() - stray[40, 40] < 0.1e5  # some of it leaves the camera
    diffuse, _ = detected((point, point), Imperfections(diffusion_px=0.35), 1)
    assert diffuse.sum() == pytest.approx(1e5, rel=1e-4)
    assert diffuse[40, 40] < 0.95e5


def test_camera_loses_its_share_of_the_brightest_pixel(bench: Bench) -> None:
    em_camera = camera_of(bench, 0.1)
    electrons = np.full((80, 80), 1e5, np.float32)
    electrons[:, 40:] = 0.5e5
    counts = em_camera.counts(electrons) * em_camera.settings.electrons_per_count
    assert (counts[0, 0], counts[0, 79]) == (pytest.approx(0.9e5), pytest.approx(0.95 * 0.5e5))
    frame = em_camera.exposed(electrons, 1, 0) * em_camera.settings.electrons_per_count
    assert frame[:, :40].mean() == pytest.approx(0.9e5, rel=1e-3)
    assert frame[:, 40:].mean() == pytest.approx(0.95 * 0.5e5, rel=1e-3)


def test_calibrated_camera_knows_its_light(bench: Bench) -> None:
    em_camera, light = camera_of(bench, 0.02), np.linspace(0, 2e5, 300, dtype=np.float32)
    electrons = np.tile(light, (200, 1))
    measured = em_camera.linearity(electrons, 1).light(em_camera.counts(light))
    assert measured * em_camera.settings.electrons_per_count == pytest.approx(light, rel=2e-3, abs=300)


@pytest.mark.slow
def test_study_shows_residual_error_bar_and_flags(bench: Bench) -> None:
    chosen = [each for each in CASES if each.name in {"none", "absorption 16 %", "defocus 4 %"}]
    table, _ = imperfect_bench(Asked(bench), chosen)
    found = table.set_index(["curve", "at"])
    assert len(found) == 12
    mean_rad = found["mean_rad"]
    assert mean_rad["free", "defocus 4 %"] > 2 * mean_rad["free", "none"]
    assert mean_rad["free", "absorption 16 %"] < 1.2 * mean_rad["free", "none"]  # its brightness is fitted
    assert found.loc[("layers", "none"), "flags"] == ""
    assert "SCALE" in found.loc[("free", "defocus 4 %"), "flags"]
    assert 0 <= found.loc[("layers: error bar", "none"), "coverage"] <= 1
