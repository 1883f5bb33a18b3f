"""The sample's light at the lenslets: brightness of subimages, truth, absorption and rays beside the screen."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.optics import FIELD, sensor_of

from app.acquisition.devices import scene_of
from app.bench.config import load_bench
from reconstruction.arrays import Floats, Image
from reconstruction.geometry import Lattice
from simulated_devices.optics.phase_screen import PhaseScreen, middle_of
from simulated_devices.optics.propagated_light import PropagatedLight
from simulated_devices.rendering import Renderer
from simulated_devices.sample import Sample, generated, make_sample, scintillation, screen_size
from simulated_devices.settings import Screen, Simulation

SENSOR = sensor_of(5, 7)
PAPER_FIELD = replace(FIELD, neglect_propagation=True)
STILL = Simulation(screen=Screen(rms_rad=2.0))
K = SENSOR.wavenumber_rad_per_m


def middle_brightness(image: Image, lattice: Lattice, rows: int, columns: int) -> Floats:
    """Mean over 5 x 5 pixels in the middle of each subimage, (lenslet,)."""
    centers_px = lattice.lenslet_centers_px(rows, columns).reshape(-1, 2)
    first = np.rint(centers_px).astype(int) - 2
    return np.array([image[y : y + 5, x : x + 5].mean() for x, y in first])


@pytest.mark.slow
@pytest.mark.parametrize("screen", ["pupil", "source"])
def test_subimages_keep_their_brightness_in_real_light(screen: str) -> None:
    """As through any lens: what a subimage gains in area it gains in light. Without propagation, flux is conserved."""
    settings = {
        "pupil": ("rms_rad=4.2", "correlation_length_m=1.6e-3"),
        "source": ("placement=source", "distance_m=0.05", "rms_rad=3", "correlation_length_m=1.0e-3"),
    }[screen]
    changes: dict[bool, float] = {}
    for neglect in (False, True):
        chosen = [f"simulation.screen.{one}" for one in settings]
        bench = load_bench(
            "small_demo", (*chosen, "simulation.object_samples=37", f"field.neglect_propagation={str(neglect).lower()}")
        )
        renderer = Renderer(scene_of(bench))
        images = renderer.reference("square"), renderer.state("square", 0)
        lattice = bench.design_lattice(*images[0].shape)
        reference, frame = (middle_brightness(image, lattice, 7, 7) for image in images)
        changes[neglect] = float(np.std(frame / reference))
    assert changes[False] < 3e-3
    assert changes[True] > 0.015


def lens_sample(curvature: float, slope: float, folder: Path, **settings: object) -> tuple[Sample, Simulation]:
    along_m = (np.arange(401) - 200) * 25e-6
    np.save(folder / "lens.npy", curvature / 2 * (along_m**2 + along_m[:, None] ** 2) + slope * along_m)
    screen = Screen(file=str(folder / "lens.npy"), distance_m=0.15, **settings)  # type: ignore[arg-type] # by name
    simulation = Simulation(screen=screen)
    return make_sample(simulation, SENSOR, FIELD), simulation


def test_truth_is_the_phase_of_the_light_at_the_lenslets(tmp_path: Path) -> None:
    """Behind a lens with a tilt: curvature c / m about the point that the tilt moves, m = 1 + c z / k."""
    curvature, slope, shift_m = 5e6, 4e3, (0.1e-3, -0.2e-3)
    sample, _ = lens_sample(curvature, slope, tmp_path)
    stretch = 1 + curvature * 0.15 / K
    found = sample.wavefront(shift_m)
    centers_m = SENSOR.lenslet_centers_m
    for row, column in ((0, 2), (1, 1), (2, 0)):
        moved = centers_m - 0.15 / 0.2 * np.array([FIELD.view_x_m[column], FIELD.view_y_m[row]]) - shift_m
        expected = (curvature / 2 * (moved**2).sum(axis=-1) + slope * moved[..., 0]) / stretch
        np.testing.assert_allclose(found[row, column], expected - expected.mean(), atol=3e-3)
    np.testing.assert_allclose(sample.intensity(), stretch**-2, rtol=2e-3)
    assert scintillation(sample.intensity()) == pytest.approx(1 - stretch**-2, rel=0.02)


def test_drift_near_the_source_moves_light_by_the_magnification(tmp_path: Path) -> None:
    """A lens at f1 / 4 behind the mask has 1/16 of its curvature in the pupil, and moves there four times as fast."""
    curvature, d, shift_m = 1e8, 0.05, (0.05e-3, -0.1e-3)
    along_m = (np.arange(301) - 150) * 10e-6
    np.save(tmp_path / "lens.npy", curvature / 2 * (along_m**2 + along_m[:, None] ** 2))
    screen = Screen(file=str(tmp_path / "lens.npy"), placement="source", distance_m=d, sample_spacing_m=10e-6)
    sample = make_sample(Simulation(screen=screen), SENSOR, FIELD)
    stretch = 1 + 0.6 * curvature / 16 / K
    found = sample.wavefront(shift_m)
    for row, column in ((0, 2), (1, 1)):
        center_m = 3 * np.array([FIELD.view_x_m[column], FIELD.view_y_m[row]]) + 4 * np.array(shift_m)
        expected = curvature / 16 / 2 * ((SENSOR.lenslet_centers_m - center_m) ** 2).sum(axis=-1) / stretch
        np.testing.assert_allclose(found[row, column], expected - expected.mean(), atol=5e-3)
    u_m, v_m = SENSOR.pupil_x_m, SENSOR.pupil_y_m
    moved, still = (sample.light_of_points(u_m, v_m, by_m)(0.0, 0.0) for by_m in (shift_m, (0.0, 0.0)))
    center_m = 4 * np.array(shift_m)
    change = curvature / 16 / stretch * (-u_m * center_m[0] - v_m[:, None] * center_m[1])
    ratio = moved / still * np.exp(-1j * change)
    np.testing.assert_allclose(ratio / ratio[2, 3], 1, atol=6e-3)


@pytest.mark.slow
@pytest.mark.parametrize("placement", ["pupil", "source"])
def test_used_light_does_not_feel_the_edge_of_the_screen(placement: str) -> None:
    """Other noise beyond the guard changes nothing."""
    screen = Screen(rms_rad=3.0, samples=185, correlation_length_m=0.8e-3)
    if placement == "source":
        screen = replace(screen, placement="source", distance_m=0.05, sample_spacing_m=10e-6)
    simulation = Simulation(screen=screen)
    sample = make_sample(simulation, SENSOR, FIELD)
    rays = sample.ray_map
    size = screen_size(simulation, SENSOR, FIELD, rays)
    assert size.guard > 10
    length_m, spacing_m = screen.correlation_length_m, screen.sample_spacing_m
    larger = generated(
        1,
        samples=screen.samples,
        sample_spacing_m=spacing_m,
        correlation_length_m=length_m,
        enlarged_by=size.enlarged_by,
        guard=size.guard + 150,
    )
    inner = middle_of(larger, size.guard + 150)
    scale = sample.screen.samples_rad.std() / inner.std()
    light = PropagatedLight(
        PhaseScreen(larger * scale, spacing_m),
        None,
        rays,
        half_width_m=sample.screen.half_width_m,
        collimator_focal_length_m=0.2,
        wavenumber_rad_per_m=K,
    )
    reach_m = 1.75e-3 + abs(rays.ratio) * 0.6e-3
    along_m = np.linspace(-reach_m, reach_m, 61)
    found, expected = (one.at(along_m, along_m[:, None]) for one in (sample.light, light))
    ratio = found / expected  # the mean phase of a screen is a piston
    np.testing.assert_allclose(ratio * np.exp(-1j * np.angle(ratio.mean())), 1, atol=3e-3)
    assert np.std(np.abs(found)) > 0.03


def test_transmission_has_the_rms_and_leaves_the_phase_alone() -> None:
    absorbing = replace(STILL, screen=replace(STILL.screen, transmission_rms=0.16))
    for field in (FIELD, PAPER_FIELD):
        clear, sample = (make_sample(simulation, SENSOR, field) for simulation in (STILL, absorbing))
        np.testing.assert_array_equal(sample.screen.samples_rad, clear.screen.samples_rad)
        assert clear.amplitude is None
        assert sample.amplitude is not None
        transmission = sample.amplitude.samples_rad**2
        assert transmission.mean() == pytest.approx(1)
        assert transmission.std() == pytest.approx(0.16, rel=0.1)
        # The correlation of smoothed white noise falls to exp(-1/4) at its sigma, here 20 samples.
        about = np.log(transmission) - np.log(transmission).mean()
        correlation = np.mean(about[:, 20:] * about[:, :-20]) / np.mean(about**2)
        assert correlation == pytest.approx(np.exp(-0.25), abs=0.05)


def test_absorbed_light_is_missing_at_the_lenslets() -> None:
    absorbing = replace(STILL, screen=replace(STILL.screen, transmission_rms=0.16, rms_rad=0.0, distance_m=0.02))
    uniform = make_sample(absorbing, SENSOR, PAPER_FIELD)
    found = uniform.intensity()
    assert uniform.amplitude is not None
    centers_m = SENSOR.lenslet_centers_m
    x_m = centers_m[..., 0] + 0.02 / 0.2 * 0.5e-3  # view (1, 0)
    np.testing.assert_allclose(found[1, 0], uniform.amplitude.at(x_m, centers_m[..., 1]) ** 2, rtol=1e-9)
    assert found.std() > 0.1
    real = make_sample(absorbing, SENSOR, FIELD).intensity()
    assert np.std(real - found) < 0.05 * found.std()  # 20 mm of propagation wash out little of 0.5 mm


def test_transmission_is_read_from_its_file(tmp_path: Path) -> None:
    samples = STILL.screen.samples
    y, x = np.mgrid[-1 : 1 : samples * 1j, -1 : 1 : samples * 1j]
    np.save(tmp_path / "t.npy", 0.5 + 0.3 * x * y)
    simulation = replace(STILL, screen=replace(STILL.screen, transmission_file=str(tmp_path / "t.npy")))
    assert simulation.files == (tmp_path / "t.npy",)
    sample = make_sample(simulation, SENSOR, FIELD)
    assert sample.amplitude is not None
    np.testing.assert_allclose(sample.amplitude.samples_rad**2, 0.5 + 0.3 * x * y, rtol=1e-12)


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        (np.full((385, 384), 0.5), r"^transmission_file must have the 385 x 385 samples of the screen"),
        (np.full((385, 385), 1.5), r"^transmission_file = .* must hold values of 0 \.\.\. 1"),
        (np.full((385, 385), np.nan), r"^transmission_file = .* must hold a 2-D array of finite values"),
        (np.zeros(3), r"^transmission_file = .* must hold"),
    ],
)
def test_bad_transmission_is_refused(tmp_path: Path, values: Floats, sentence: str) -> None:
    np.save(tmp_path / "t.npy", values)
    simulation = replace(STILL, screen=replace(STILL.screen, transmission_file=str(tmp_path / "t.npy")))
    with pytest.raises(ValueError, match=sentence):
        make_sample(simulation, SENSOR, FIELD)


def test_screen_after_the_mask_is_not_behind_it() -> None:
    with pytest.raises(ValueError, match=r"^distance_m must be 0 or more"):
        Screen(distance_m=-0.1, placement="source")
