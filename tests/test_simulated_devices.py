"""The simulated bench and its devices: the contract of all devices, and what only a simulation can promise."""

from __future__ import annotations

import errno
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO

import numpy as np
import pytest
from device_contract import CameraContract, LightContract, StageContract

from drivers.interface import BadValue, DeviceTimeout, Disconnected
from reconstruction.geometry import Field, Lattice, Sensor
from simulated_devices.background import BackgroundRendering, render_missing
from simulated_devices.bench import PHOTONS_PER_S_M2_A, SimulatedBench
from simulated_devices.camera import LoseFrames, SimulatedCamera, Stall, Unplug
from simulated_devices.clock import ManualClock
from simulated_devices.light import SimulatedLight
from simulated_devices.playback import Playback
from simulated_devices.rendering import ImageCache
from simulated_devices.settings import (
    Screen,
    SimulatedCameraSettings,
    SimulatedLightSettings,
    Simulation,
    Source,
    exposure_range_s,
)
from simulated_devices.stage import SimulatedStage

SENSOR = Sensor(
    lenslet_rows=3,
    lenslet_columns=4,
    lenslet_pitch_m=500e-6,
    lenslet_focal_length_m=46.7e-3,
    wavelength_m=462e-9,
    pixel_pitch_m=16e-6,
)
LATTICE = Lattice(center_x_px=70.0, center_y_px=50.0, pitch_px=31.25)
FIELD = Field(collimator_focal_length_m=0.2, half_width_m=0.6e-3)
STILL = Simulation(object_samples=5, pupil_samples=10, screen=Screen(correlation_length_m=0.5e-3, samples=150))
DRIFTING = replace(STILL, drifting_states=4, screen=replace(STILL.screen, drift_x_m_per_s=1e-3))
CAMERA = SimulatedCameraSettings(rows=100, columns=140)


def open_bench(
    folder: Path,
    simulation: Simulation = STILL,
    camera: SimulatedCameraSettings = CAMERA,
    progress: Callable[[float], None] | None = None,
) -> SimulatedBench:
    return SimulatedBench(
        SENSOR,
        LATTICE,
        FIELD,
        simulation,
        camera,
        SimulatedLightSettings(),
        cache_folder=folder,
        clock=ManualClock(),
        progress=progress,
    )


@pytest.fixture(scope="session")
def cache_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("simulated")


@pytest.fixture
def bench(cache_folder: Path) -> Iterator[SimulatedBench]:
    bench = open_bench(cache_folder)
    yield bench
    bench.close()


@pytest.fixture
def camera(bench: SimulatedBench) -> Iterator[SimulatedCamera]:
    with SimulatedCamera(bench) as camera:
        yield camera


@pytest.fixture
def light(bench: SimulatedBench) -> Iterator[SimulatedLight]:
    with SimulatedLight(bench) as light:
        yield light


@pytest.fixture
def stage(bench: SimulatedBench) -> Iterator[SimulatedStage]:
    with SimulatedStage(bench) as stage:
        yield stage


class TestSimulatedCamera(CameraContract):
    pass


class TestSimulatedLight(LightContract):
    pass


class TestSimulatedStage(StageContract):
    pass


def test_frames_come_at_their_own_pace(bench: SimulatedBench, camera: SimulatedCamera) -> None:
    camera.set_exposure(0.02)
    camera.start()
    assert [camera.read(1.0).camera_time_s for _ in range(4)] == pytest.approx([0.02, 0.04, 0.06, 0.08])
    assert bench.clock.now() == pytest.approx(0.08, abs=1e-4)


def test_a_late_reader_finds_the_newest_eight_frames(bench: SimulatedBench, camera: SimulatedCamera) -> None:
    camera.set_exposure(0.02)
    camera.start()
    bench.clock.sleep(20.5 * 0.02)  # 20 complete frames, 0 ... 19
    assert [camera.read(0.0).index for _ in range(8)] == list(range(12, 20))
    with pytest.raises(DeviceTimeout):
        camera.read(0.0)


def test_a_timeout_takes_its_time_and_no_more(bench: SimulatedBench, camera: SimulatedCamera) -> None:
    camera.set_exposure(1.0)
    camera.start()
    with pytest.raises(DeviceTimeout):
        camera.read(0.3)
    assert bench.clock.now() == pytest.approx(0.3, abs=1e-3)


def test_the_exposure_is_rounded_to_ten_microseconds(camera: SimulatedCamera) -> None:
    assert camera.exposure_s == 0.01429
    assert camera.set_exposure(0.0200049) == 0.02


def test_exposure_limits_are_those_of_the_property_sheet(bench: SimulatedBench, camera: SimulatedCamera) -> None:
    assert (camera.capabilities.exposure_range_s.minimum, camera.capabilities.exposure_range_s.maximum) == (0.0139, 1.0)
    with pytest.raises(BadValue):
        camera.set_exposure(3.8)
    camera.set_amplifier("normal")
    assert camera.exposure_s == 0.42147  # moved into the range
    camera.set_exposure(3.8)
    with pytest.raises(BadValue):
        camera.set_exposure(0.15)
    assert exposure_range_s("em", 2).minimum == 0.02713
    assert exposure_range_s("em", 1).minimum == 0.42147
    assert exposure_range_s("em", 2).maximum == 7200
    assert bench.camera_settings.readout_speed == 3


def test_a_change_while_running_leaves_waiting_frames_as_they_were(
    bench: SimulatedBench, camera: SimulatedCamera
) -> None:
    camera.set_exposure(0.02)
    camera.start()
    bench.clock.sleep(0.05)  # two complete, half of the third
    camera.set_exposure(0.1)
    camera.set_em_gain(50.0)
    frames = [camera.read(1.0) for _ in range(4)]
    assert [frame.exposure_s for frame in frames] == [0.02, 0.02, 0.1, 0.1]
    assert [frame.em_gain for frame in frames] == [1.0, 1.0, 50.0, 50.0]
    assert [frame.index for frame in frames] == [0, 1, 2, 3]
    assert [frame.camera_time_s for frame in frames] == pytest.approx([0.02, 0.04, 0.15, 0.25])


def test_light_is_proportional_to_current_and_exposure(
    bench: SimulatedBench, camera: SimulatedCamera, light: SimulatedLight
) -> None:
    light.set_on(True)
    camera.start()
    means = []
    for current_a, exposure_s in ((0.2, 0.02), (0.4, 0.02), (0.2, 0.06)):
        light.set_current(current_a)
        camera.set_exposure(exposure_s)
        means.append(camera.read(1.0).pixels.mean() - 500.0)
    assert means[1] / means[0] == pytest.approx(2.0, rel=0.01)
    assert means[2] / means[0] == pytest.approx(3.0, rel=0.01)
    photons = bench.render_reference("square").mean() * PHOTONS_PER_S_M2_A * 0.2 * 0.02
    assert means[0] == pytest.approx(photons * 0.8 / 5.8, rel=0.01)


def test_a_change_during_an_exposure_counts_for_its_part(
    bench: SimulatedBench, camera: SimulatedCamera, light: SimulatedLight, stage: SimulatedStage
) -> None:
    camera.set_exposure(0.1)
    light.set_current(0.1)
    camera.start()
    bench.clock.sleep(0.075)
    light.set_on(True)
    bench.clock.sleep(0.05)
    stage.set_sample_in(True)
    bench.clock.sleep(0.175)
    dark_and_light, mixed, sample = (camera.read(1.0).pixels.astype(float) - 500 for _ in range(3))
    whole = bench.render_reference("square").mean() * PHOTONS_PER_S_M2_A * 0.1 * 0.1 * 0.8 / 5.8
    assert dark_and_light.mean() == pytest.approx(0.25 * whole, rel=0.01)
    assert (camera.state_of_frame(0), camera.state_of_frame(2)) == (None, 0)
    # A quarter of the second exposure saw the reference: the rest looks like the third.
    expected = 0.75 * sample + dark_and_light
    assert abs(mixed - expected).max() < 8 * math.sqrt(sample.max() / 5.8 * 2 + 100)


def test_the_light_goes_out_when_it_is_opened_and_closed(bench: SimulatedBench) -> None:
    bench.change(is_light_on=True)
    light = SimulatedLight(bench)
    assert not bench.condition.is_light_on
    light.set_on(True)
    light.close()
    assert not bench.condition.is_light_on


def test_an_unplugged_device_is_disconnected(camera: SimulatedCamera, light: SimulatedLight) -> None:
    camera.start()
    camera.inject(Unplug())
    with pytest.raises(Disconnected):
        camera.read(1.0)
    with pytest.raises(Disconnected):
        camera.stop()
    light.unplug()
    with pytest.raises(Disconnected):
        light.set_on(True)


def test_a_stalled_camera_times_out_until_it_is_started_again(camera: SimulatedCamera) -> None:
    camera.start()
    camera.inject(Stall())
    with pytest.raises(DeviceTimeout):
        camera.read(1.0)
    camera.stop()
    camera.start()
    assert camera.read(1.0).index == 0


def test_lost_frames_show_as_a_gap(camera: SimulatedCamera) -> None:
    camera.start()
    assert camera.read(1.0).index == 0
    camera.inject(LoseFrames(3))
    assert camera.read(1.0).index == 4


def test_both_exposures_of_the_paper_come_near_seventy_per_cent_of_full_scale(tmp_path: Path) -> None:
    simulation = replace(STILL, object_samples=37, pupil_samples=20)
    settings = replace(CAMERA, readout_speed=2, exposure_s=0.15)
    bench = open_bench(tmp_path, simulation, settings)
    with SimulatedCamera(bench) as camera, SimulatedLight(bench) as light, SimulatedStage(bench) as stage:
        light.set_on(True)
        for mask, exposure_s, lowest, highest in (("square", 0.15, 0.52, 0.62), ("stars", 3.8, 0.8, 0.9)):
            stage.set_mask(mask)
            camera.set_exposure(exposure_s)
            camera.start()
            assert lowest < camera.read(10.0).pixels.max() / 65535 < highest
            camera.stop()
    bench.close()


def test_live_frames_use_the_scale_with_the_multiplier(tmp_path: Path) -> None:
    bench = open_bench(tmp_path, replace(STILL, object_samples=19, pupil_samples=12))
    with SimulatedCamera(bench) as camera, SimulatedLight(bench) as light:
        light.set_current(1.0)
        camera.set_em_gain(4.0)
        light.set_on(True)
        camera.start()
        assert 0.5 < camera.read(1.0).pixels.max() / 65535 < 0.8


def test_states_are_rendered_ahead_and_played(cache_folder: Path) -> None:
    bench = open_bench(cache_folder / "drifting", DRIFTING)
    try:
        deadline = time.monotonic() + 30
        while bench.states_rendered < 4 and time.monotonic() < deadline:
            time.sleep(0.05)
            bench.clock.sleep(0.25)
            bench.current_state(bench.clock.now())
        assert bench.states_rendered == 4
        seen = []
        for _ in range(12):
            bench.clock.sleep(0.1)
            seen.append(bench.current_state(bench.clock.now()))
        assert set(seen) == {0, 1, 2, 3}
        assert (abs(np.diff(seen)) == 1).all()
        drift = bench.truth_wavefront(1) - bench.truth_wavefront(0)
        assert 0.01 < drift.std() < bench.truth_wavefront(0).std()
    finally:
        bench.close()


def test_the_background_process_ends_at_once(tmp_path: Path) -> None:
    slow = replace(DRIFTING, object_samples=101, drifting_states=50)
    bench = open_bench(tmp_path, replace(slow, object_samples=5))
    process = bench._background
    assert process is not None
    assert process._process.poll() is None
    start = time.monotonic()
    bench.close()
    bench.close()
    assert process._process.poll() is not None
    assert time.monotonic() - start < 1


def test_the_background_process_comes_to_a_quiet_end(
    bench: SimulatedBench, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    scene = replace(bench._scene, simulation=DRIFTING)
    process = BackgroundRendering(scene, "square", tmp_path)
    assert process._process.wait(60) == 0
    process.close()
    assert capfd.readouterr().err == ""
    cache = ImageCache(tmp_path, scene)
    assert all(cache.load("square", state) is not None for state in range(4))


def test_a_cache_that_cannot_be_written_keeps_nothing_and_the_bench_goes_on(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("no folder")
    bench = open_bench(tmp_path / "file", DRIFTING)
    assert bench._background is not None
    assert bench._background._process.wait(60) == 0
    bench.clock.sleep(10.0)
    bench.change(is_light_on=True, is_sample_in=True)
    bench.clock.sleep(1.0)
    exposed = bench.expose(bench.clock.now() - 1.0, bench.clock.now())
    assert (exposed.state, bench.states_rendered) == (0, 1)
    assert exposed.photons.any()
    bench.close()
    assert capfd.readouterr().err == ""


def test_a_full_disk_leaves_nothing_half_written(
    bench: SimulatedBench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def write_some(file: BinaryIO, _: object) -> None:
        file.write(b"\x93NUMPY")
        raise OSError(errno.ENOSPC, "No space left on device")

    cache = ImageCache(tmp_path, bench._scene)
    image = bench.render_reference("square")
    with monkeypatch.context() as patch:
        patch.setattr(np, "save", write_some)
        assert not cache.save("square", 0, image)
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]
    assert cache.save("square", 0, image)
    np.testing.assert_array_equal(cache.load("square", 0), image)


def test_progress_runs_over_the_reference_and_the_first_state(tmp_path: Path) -> None:
    heard: list[float] = []
    open_bench(tmp_path, progress=heard.append).close()
    assert heard == sorted(heard)
    assert 0 < heard[0] < 0.1
    assert sum(fraction < 0.25 for fraction in heard) >= 3  # the reference
    assert sum(0.25 < fraction < 1 for fraction in heard) >= 3  # the state
    assert heard[-1] == 1
    heard.clear()
    open_bench(tmp_path, progress=heard.append).close()
    assert heard == [1.0]


def test_a_damaged_file_is_rendered_anew(tmp_path: Path) -> None:
    first = open_bench(tmp_path)
    whole = first.expose(0.0, 1.0)
    first.change(is_light_on=True, is_sample_in=True)
    first.clock.sleep(1.0)
    good = first.expose(0.0, 1.0).photons
    assert not whole.photons.any()
    (file,) = tmp_path.glob("*/square-0.npy")
    file.write_bytes(file.read_bytes()[:1000])
    again = open_bench(tmp_path)
    again.change(is_light_on=True, is_sample_in=True)
    again.clock.sleep(1.0)
    np.testing.assert_allclose(again.expose(0.0, 1.0).photons, good, rtol=1e-4)
    assert file.stat().st_size > 1000


def test_a_damaged_file_is_rendered_anew_in_the_background(tmp_path: Path) -> None:
    bench = open_bench(tmp_path, DRIFTING)
    bench.close()
    scene = bench._scene
    render_missing(scene, "stars", tmp_path)
    cache = ImageCache(tmp_path, scene)
    good = cache.load("stars", 2)
    cache.path("stars", 2).write_bytes(b"\x93NUMPY damaged")
    assert cache.load("stars", 2) is None
    render_missing(scene, "stars", tmp_path)
    np.testing.assert_array_equal(cache.load("stars", 2), good)


def test_every_parameter_has_images_of_its_own(bench: SimulatedBench) -> None:
    scene = bench._scene
    others = [
        replace(scene, rows=101),
        replace(scene, simulation=replace(STILL, seed=2)),
        replace(scene, simulation=replace(STILL, screen=replace(STILL.screen, drift_y_m_per_s=1e-6))),
        replace(scene, lattice=replace(LATTICE, rotation_rad=1e-6)),
        replace(scene, pixel_fill_factor=0.0),
    ]
    assert len({scene.fingerprint(), *(other.fingerprint() for other in others)}) == 6


def test_a_film_is_played_back_and_forth_and_grows_without_a_jump() -> None:
    film = Playback(states=3, duration_s=1.0, start_s=0.0)
    assert [film.state_at(time_s + 0.5) for time_s in range(7)] == [0, 1, 2, 1, 0, 1, 2]
    film.states = 5
    assert [film.state_at(time_s + 0.5) for time_s in range(7, 12)] == [3, 4, 3, 2, 1]
    assert film.state_at(8.5) == 4  # what was shown is remembered
    later = film.state_at(1e6)
    assert film.state_at(1e6 + 1) != later
    still = Playback(states=1, duration_s=1.0, start_s=0.0)
    assert [still.state_at(time_s + 0.5) for time_s in range(3)] == [0, 0, 0]


@pytest.mark.parametrize(
    ("make", "key"),
    [
        (lambda: Simulation(pupil_samples=7), "pupil_samples"),
        (lambda: Simulation(object_samples=1), "object_samples"),
        (lambda: Screen(distance_m=math.nan), "distance_m"),
        (lambda: Screen(pv_rad=1.0), "pv_rad"),
        (lambda: Source(pinhole_diameter_m=-1e-6), "pinhole_diameter_m"),
        (lambda: SimulatedCameraSettings(exposure_s=3.8), "exposure_s"),
        (lambda: SimulatedCameraSettings(readout_speed=4), "readout_speed"),
        (lambda: SimulatedCameraSettings(em_gain=0.5), "em_gain"),
        (lambda: SimulatedCameraSettings(amplifier="normal", exposure_s=1.0, em_gain=4.0), "em_gain"),
        (lambda: SimulatedLightSettings(current_a=2.0), "current_a"),
    ],
)
def test_a_bad_setting_is_named(make: type[object], key: str) -> None:
    with pytest.raises(ValueError, match=f"^{key} "):
        make()
