"""The simulated devices: the contract of all devices, and what only a simulation can promise."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.camera_contract import CameraFaultContract
from support.light_contract import LightFaultContract
from support.simulated_scene import CAMERA, STILL, SimulatedCameraFaults, SimulatedLightFaults, open_bench
from support.stage_contract import StageContract

from drivers.interface import BadValue, DeviceTimeout, Range, Region
from simulated_devices.bench import PHOTONS_PER_S_M2_A, SimulatedBench, SimulatedLight, SimulatedStage
from simulated_devices.camera import SimulatedCamera
from simulated_devices.detector import Detector
from simulated_devices.settings import exposure_range_s


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


class TestSimulatedCamera(CameraFaultContract):
    @pytest.fixture
    def reopen(self, bench: SimulatedBench) -> Callable[[], SimulatedCamera]:
        return lambda: SimulatedCamera(bench)

    @pytest.fixture
    def faults(self, camera: SimulatedCamera) -> SimulatedCameraFaults:
        return SimulatedCameraFaults(camera)


class TestSimulatedLight(LightFaultContract):
    @pytest.fixture
    def reopen(self, bench: SimulatedBench) -> Callable[[], SimulatedLight]:
        return lambda: SimulatedLight(bench)

    @pytest.fixture
    def faults(self, bench: SimulatedBench, light: SimulatedLight) -> SimulatedLightFaults:
        return SimulatedLightFaults(bench, light)


class TestSimulatedStage(StageContract):
    pass


def test_frames_come_at_the_exposure_period(bench: SimulatedBench, camera: SimulatedCamera) -> None:
    camera.set_exposure(0.02)
    camera.start()
    assert [camera.read(1.0).camera_time_s for _ in range(4)] == pytest.approx([0.02, 0.04, 0.06, 0.08])
    assert bench.clock.now() == pytest.approx(0.08, abs=1e-4)


def test_late_reader_gets_newest_eight_frames(bench: SimulatedBench, camera: SimulatedCamera) -> None:
    camera.set_exposure(0.02)
    camera.start()
    bench.clock.sleep(20.5 * 0.02)  # 20 complete frames, 0 ... 19
    assert [camera.read(0.0).index for _ in range(8)] == list(range(12, 20))
    with pytest.raises(DeviceTimeout):
        camera.read(0.0)


def test_timeout_lasts_the_requested_time(bench: SimulatedBench, camera: SimulatedCamera) -> None:
    camera.set_exposure(1.0)
    camera.start()
    with pytest.raises(DeviceTimeout):
        camera.read(0.3)
    assert bench.clock.now() == pytest.approx(0.3, abs=1e-3)


def test_exposure_limits_match_the_property_sheet(bench: SimulatedBench, camera: SimulatedCamera) -> None:
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


def test_change_while_running_leaves_waiting_frames(bench: SimulatedBench, camera: SimulatedCamera) -> None:
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


def test_gain_changed_amid_an_exposure_leaves_its_end(bench: SimulatedBench, camera: SimulatedCamera) -> None:
    camera.set_exposure(0.02)
    camera.start()
    bench.clock.sleep(0.05)
    camera.set_em_gain(50.0)
    frames = [camera.read(1.0) for _ in range(4)]
    assert [frame.em_gain for frame in frames] == [1.0, 1.0, 50.0, 50.0]
    assert [frame.camera_time_s for frame in frames] == pytest.approx([0.02, 0.04, 0.06, 0.08])


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
    photons = bench.references["square"].mean() * PHOTONS_PER_S_M2_A * 0.2 * 0.02
    assert means[0] == pytest.approx(photons * 0.8 / 5.8, rel=0.01)


def test_change_during_exposure_counts_in_proportion(
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
    whole = bench.references["square"].mean() * PHOTONS_PER_S_M2_A * 0.1 * 0.1 * 0.8 / 5.8
    assert dark_and_light.mean() == pytest.approx(0.25 * whole, rel=0.01)
    assert (camera.state_of_frame(0), camera.state_of_frame(2)) == (None, 0)
    # A quarter of the second exposure saw the reference: the rest looks like the third.
    expected = 0.75 * sample + dark_and_light
    assert abs(mixed - expected).max() < 8 * math.sqrt(sample.max() / 5.8 * 2 + 100)


@pytest.mark.slow
def test_both_paper_exposures_reach_70_percent_of_full_scale(tmp_path: Path) -> None:
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


def test_readout_speed_sets_exposure_range_and_noise(camera: SimulatedCamera) -> None:
    spreads = []
    for speed, minimum_s, maximum_s in ((3, 0.0139, 1.0), (2, 0.02713, 7200), (1, 0.42147, 7200)):
        camera.set_readout_speed(speed)
        assert camera.capabilities.exposure_range_s == Range(minimum_s, maximum_s)
        assert camera.exposure_s == max(minimum_s, 0.01429)  # moved into the range
        camera.start()
        spreads.append(camera.read(1.0).pixels.std() * 5.8)
        camera.stop()
    assert spreads == pytest.approx([37, 25, 8], rel=0.05)
    camera.set_amplifier("normal")
    assert camera.capabilities.readout_speeds == (1,)


def test_region_is_part_of_the_whole_frame(camera: SimulatedCamera, light: SimulatedLight) -> None:
    light.set_on(True)
    camera.start()
    whole = camera.read(1.0).pixels.astype(float)
    camera.stop()
    part = Region(top=16, left=48, rows=64, columns=80)
    camera.set_region(part)
    camera.start()
    shown = camera.read(1.0).pixels.astype(float)
    difference = shown - whole[16:80, 48:128]
    spread = np.sqrt(whole.max() * 2 / 5.8 + 100)
    assert abs(difference).max() < 8 * spread
    assert abs(shown - whole[17:81, 48:128]).max() > 30 * spread  # one row off


def test_repeated_frames_are_computed_once(cache_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bench = open_bench(cache_folder)
    bench.camera_settings = replace(CAMERA, noise_frames=2, shortest_exposure_s=1e-3, exposure_s=2e-3)
    computed: list[int] = []
    counts = Detector.counts

    def counted(*arguments: Any, **named: Any) -> Any:
        computed.append(1)
        return counts(*arguments, **named)

    monkeypatch.setattr(Detector, "counts", counted)
    with closing(bench), SimulatedCamera(bench) as camera, SimulatedLight(bench) as light:
        light.set_on(True)
        assert camera.capabilities.exposure_range_s.minimum == 1e-3
        camera.start()
        camera.read(1.0)  # the light was off at the very beginning of its exposure
        computed.clear()
        frames = [camera.read(1.0) for _ in range(7)]
        assert len(computed) == 2
        assert [frame.index for frame in frames] == list(range(1, 8))
        assert frames[6].camera_time_s - frames[0].camera_time_s == pytest.approx(6 * 2e-3)
        for frame in frames[2:]:
            np.testing.assert_array_equal(frame.pixels, frames[(frame.index - 1) % 2].pixels)
        assert (frames[0].pixels != frames[1].pixels).any()
        assert not np.shares_memory(frames[0].pixels, frames[2].pixels)
        light.set_on(False)
        camera.read(1.0)
        dark = camera.read(1.0)
        assert dark.pixels.mean() < frames[0].pixels.mean()
