"""The simulated bench: rendering ahead, image cache, playback and settings."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.patience import HANG_S, wait_until
from support.posix import KILLED
from support.simulated_scene import DRIFTING, LATTICE, STILL, current_state, open_bench, states_rendered

from simulated_devices.bench import SimulatedBench, played_state
from simulated_devices.rendering import rendering_ahead
from simulated_devices.settings import Screen, SimulatedCameraSettings, SimulatedLightSettings, Simulation


@pytest.fixture(scope="module")
def cache_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("simulated")


@pytest.fixture
def bench(cache_folder: Path) -> Iterator[SimulatedBench]:
    bench = open_bench(cache_folder)
    yield bench
    bench.close()


@pytest.mark.slow
def test_states_are_rendered_ahead_and_played(cache_folder: Path) -> None:
    bench = open_bench(cache_folder / "drifting", DRIFTING)
    try:

        def all_are_rendered() -> bool:
            bench.clock.sleep(0.2)
            current_state(bench)
            return states_rendered(bench) == 4

        wait_until(all_are_rendered)
        bench.clock.sleep(0.05)  # to the middle of a state
        seen = []
        for _ in range(12):
            bench.clock.sleep(0.1)
            seen.append(current_state(bench))
        assert set(seen) == {0, 1, 2, 3}
        assert (abs(np.diff(seen)) == 1).all()
        bench.change(is_sample_in=True)
        long_s = bench.simulation.state_duration_s
        first = math.ceil((bench.clock.now() - bench._start_s) / long_s)
        for middle in (first + 0.9, first + 1.1):  # before and after a change, amid the exposure
            begin_s = bench._start_s + (middle - 0.5) * long_s
            shown = bench.expose(begin_s, begin_s + long_s).state
            assert shown == played_state(middle * long_s, states=4, rendered=4, duration_s=long_s)
        drift = bench.renderer.truth_wavefront(1) - bench.renderer.truth_wavefront(0)
        assert 0.01 < drift.std() < bench.renderer.truth_wavefront(0).std()
    finally:
        bench.close()


def test_closing_kills_rendering_ahead(tmp_path: Path) -> None:
    slowly = replace(DRIFTING.screen, drift_x_m_per_s=1e-6)
    bench = open_bench(tmp_path, replace(DRIFTING, screen=slowly, drifting_states=10_000))
    process = bench._ahead
    assert process is not None
    assert process.process.poll() is None
    bench.close()
    bench.close()
    assert process.process.returncode == KILLED


@pytest.mark.slow
@pytest.mark.parametrize("search_path", ["", os.pathsep])
def test_rendering_ahead_imports_nothing_from_working_directory(
    bench: SimulatedBench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, search_path: str
) -> None:
    (tmp_path / "numpy.py").write_text("open('executed', 'w').close(); raise SystemExit(7)")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", search_path)
    process = rendering_ahead(replace(bench._scene, simulation=DRIFTING), "square", tmp_path)
    assert process.process.wait(HANG_S) == 0
    process.close()
    assert not (tmp_path / "executed").exists()


@pytest.mark.slow
def test_bench_works_without_writable_cache(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("no folder")
    bench = open_bench(tmp_path / "file", DRIFTING)
    assert bench._ahead is not None
    assert bench._ahead.process.wait(HANG_S) == 0
    bench.clock.sleep(10.0)
    bench.change(is_light_on=True, is_sample_in=True)
    bench.clock.sleep(1.0)
    exposed = bench.expose(bench.clock.now() - 1.0, bench.clock.now())
    assert (exposed.state, states_rendered(bench)) == (0, 1)
    assert exposed.photons.any()
    bench.close()
    assert capfd.readouterr().err == ""


def test_progress_covers_reference_and_first_state(tmp_path: Path) -> None:
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


def test_damaged_file_is_rendered_again(tmp_path: Path) -> None:
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
    assert np.load(file).shape == (100, 140)


def test_every_parameter_changes_the_fingerprint(bench: SimulatedBench) -> None:
    scene = bench._scene
    others = [
        replace(scene, rows=101),
        replace(scene, simulation=replace(STILL, seed=2)),
        replace(scene, simulation=replace(STILL, screen=replace(STILL.screen, drift_y_m_per_s=1e-6))),
        replace(scene, lattice=replace(LATTICE, rotation_rad=1e-6)),
        replace(scene, pixel_fill_factor=0.0),
    ]
    assert len({scene.fingerprint(), *(other.fingerprint() for other in others)}) == 6


def test_states_are_played_back_and_forth_as_far_as_they_are_rendered() -> None:
    def shown(rendered: int, states: int = 5) -> list[int]:
        return [played_state(t + 0.5, states=states, rendered=rendered, duration_s=1.0) for t in range(-1, 10)]

    assert shown(5) == [1, 0, 1, 2, 3, 4, 3, 2, 1, 0, 1]
    assert shown(3) == [1, 0, 1, 2, 2, 2, 2, 2, 1, 0, 1]
    assert np.abs(np.subtract(shown(4), shown(3))).max() == 1  # no jump when one more is rendered
    assert shown(1, states=1) == [0] * 11


@pytest.mark.parametrize(
    ("make", "key"),
    [
        (lambda: Simulation(pupil_samples=7), "pupil_samples"),
        (lambda: Screen(pv_rad=1.0), "pv_rad"),
        (lambda: SimulatedCameraSettings(exposure_s=3.8), "exposure_s"),
        (lambda: SimulatedCameraSettings(amplifier="normal", exposure_s=1.0, em_gain=4.0), "em_gain"),
        (lambda: SimulatedLightSettings(current_a=2.0), "current_a"),
    ],
)
def test_bad_setting_is_named(make: type[object], key: str) -> None:
    with pytest.raises(ValueError, match=f"^{key} "):
        make()
