"""Bench whose camera plays a recording: its settings, its devices, and measurements with them."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from support.command_line import run
from support.pictures import assert_drawn
from support.recorded_camera import FRAMES, copied, steady_recording

from app.acquisition.devices import open_camera, open_devices
from app.bench.config import load_bench, parse_bench, write_bench
from app.bench.device_kinds import RecordingSettings
from app.commands.measure import measure_bench
from app.errors import InputError, RunError
from app.recording.reader import Recording
from app.recording.writer import RecordingWriter
from drivers.interface import BadValue
from reconstruction.wavefront import rms


@pytest.fixture(scope="module")
def steady(small_toml: Path, tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return steady_recording(small_toml, tmp_path_factory.mktemp("recording") / "run")


def ignore(_what: object, _fraction: float) -> None:
    """Progress callback that does nothing."""


def bench_text(toml: Path, folder: Path, **settings: object) -> str:
    """The bench of a TOML file with a recording as its camera."""
    camera = RecordingSettings(folder=str(folder), **settings)  # type: ignore[arg-type] # checked when read
    return write_bench(replace(load_bench(toml), camera=camera))


def test_bench_with_a_recording_opens_its_devices(small_toml: Path, steady: Recording) -> None:
    bench = parse_bench(bench_text(small_toml, steady.folder, repeat=True), "bench")
    assert bench.camera == RecordingSettings(folder=str(steady.folder), repeat=True)
    with open_devices(bench, lambda _: None) as devices:
        assert (devices.camera.name, devices.light.name, devices.stage.name) == (
            "recording run",
            "as recorded",
            "as recorded",
        )
        assert not devices.light.is_on
        assert not devices.stage.is_sample_in
        with pytest.raises(BadValue, match=r"exposure_s = 0.5 is outside 0.02 ... 0.02"):
            devices.camera.set_exposure(0.5)
        with pytest.raises(BadValue, match="there is no mask 'stars'"):
            devices.stage.set_mask("stars")
        for is_on, is_in in ((False, True), (True, True), (True, False), (False, False)):
            devices.light.set_on(is_on)
            devices.stage.set_sample_in(is_in)
            assert (devices.light.is_on, devices.stage.is_sample_in) == (is_on, is_in)
    assert devices.camera.state == "closed"
    with pytest.raises(InputError, match="has no device"):
        open_camera(bench.camera)


@pytest.mark.parametrize(
    ("override", "sentence"),
    [
        ('light.driver="thorlabs_dc2200"', "cannot be used: a recording sees no real light"),
        ('camera.pace="slow"', 'camera.pace must be one of "own", "fastest"'),
        ("camera.repeat=1", "camera.repeat must be true or false"),
        ("camera.exposure_s=0.1", "camera.exposure_s is an unknown key"),
    ],
)
def test_unusable_setting_is_one_line(small_toml: Path, steady: Recording, override: str, sentence: str) -> None:
    text = bench_text(small_toml, steady.folder)
    if override.startswith("light"):
        text = text[: text.index("[light]")] + text[text.index("[simulation]") :]
    with pytest.raises(InputError, match=sentence) as refused:
        parse_bench(text, "bench", (override,))
    assert "\n" not in str(refused.value)


def test_recording_camera_needs_a_folder(small_toml: Path) -> None:
    text = bench_text(small_toml, Path("run")).replace('folder = "run"\n', "")
    with pytest.raises(InputError, match=r"camera\.folder is missing"):
        parse_bench(text, "bench")


def test_unusable_recording_is_refused_on_opening(small_toml: Path, steady: Recording, tmp_path: Path) -> None:
    empty = tmp_path / "empty"
    with closing(RecordingWriter(empty, {"command": "live", "bench": write_bench(steady.bench)})) as writer:
        writer.finish("", acquired=0, facts={})
    damaged = copied(steady, tmp_path / "damaged").folder
    (damaged / "run.json").write_text("{")
    for folder, sentence in (
        (tmp_path / "nowhere", "no such folder"),
        (tmp_path, "holds no recording"),
        (empty, "holds no frame"),
        (damaged, r"run\.json: is damaged"),
    ):
        with pytest.raises(InputError, match=sentence):
            open_devices(parse_bench(bench_text(small_toml, folder), "bench"), lambda _: None)
    other = parse_bench(bench_text(small_toml, steady.folder), "bench", ("sensor.pixel_pitch_m=15e-6",))
    with pytest.raises(InputError, match=r"pixel_pitch_m = 1\.5e-05, but recording run reports 1\.6e-05"):
        open_devices(other, lambda _: None)


@pytest.mark.slow
@pytest.mark.long
def test_measuring_a_recording_reproduces_its_frames(small_toml: Path, tmp_path: Path) -> None:
    """Dark and reference agree exactly, the displacements within the noise of the averages."""
    measure_bench(load_bench(small_toml), tmp_path / "run", frames=12, progress=ignore)
    again = parse_bench(bench_text(small_toml, tmp_path / "run", pace="fastest"), "bench")
    made = measure_bench(again, tmp_path / "again", frames=12, progress=ignore)
    assert (made.frames, made.reconstructed) == (12, 12)
    then, now = Recording(tmp_path / "run"), Recording(tmp_path / "again")
    for name in ("dark", "reference"):
        files = [(recording.folder / f"{name}.tif").read_bytes() for recording in (then, now)]
        assert files[0] == files[1]
    with (
        xr.open_dataset(tmp_path / "run" / "results.nc") as expected,
        xr.open_dataset(tmp_path / "again" / "results.nc") as found,
    ):
        np.testing.assert_array_equal(found["valid"], expected["valid"])
        np.testing.assert_allclose(found["displacement"], expected["displacement"], rtol=0, atol=1e-3)
        assert float(np.abs(expected["displacement"]).max()) > 0.3
        np.testing.assert_allclose(found["rms"], expected["rms"], rtol=1e-3)
    for index in range(12):
        np.testing.assert_array_equal(now.pixels(index), then.pixels(index))
        assert now.line(index).exposure_s == then.line(index).exposure_s
        assert now.line(index).em_gain == then.line(index).em_gain
        assert now.line(index).light_current_a == then.line(index).light_current_a


@pytest.mark.slow
@pytest.mark.long
def test_measuring_beyond_the_end_keeps_all_frames(small_toml: Path, steady: Recording, tmp_path: Path) -> None:
    bench = parse_bench(bench_text(small_toml, steady.folder), "bench")
    with pytest.raises(RunError, match=f"recording run has ended: all {FRAMES} frames were played"):
        measure_bench(bench, tmp_path / "again", frames=FRAMES + 1, progress=ignore)
    made = Recording(tmp_path / "again")
    assert made.is_complete
    assert len(made) == FRAMES
    np.testing.assert_array_equal(made.pixels(FRAMES - 1), steady.pixels(FRAMES - 1))
    assert (tmp_path / "again" / "results.nc").exists()


@pytest.mark.slow
@pytest.mark.long
def test_window_opens_on_a_recording(
    small_toml: Path, steady: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Offscreen; the result is the wavefront of one of the frames, and has the lattice that was found."""
    bench, out = tmp_path / "bench.toml", tmp_path / "out"
    given = parse_bench(bench_text(small_toml, steady.folder, repeat=True), "bench")
    bench.write_text(write_bench(replace(given, lattice=None)))
    assert run(monkeypatch, "live", "--bench", bench, "--seconds", "0.5", "--out", out) == 0
    assert_drawn(out / "window.png")
    reconstructor = steady.calibration(0).reconstructor()
    expected = [rms(reconstructor(steady.pixels(index)).views) for index in range(FRAMES)]
    with xr.open_dataset(out / "result.nc") as shown:
        assert any(np.allclose(shown["rms"], each, rtol=5e-3) for each in expected)
        assert parse_bench(shown.attrs["bench"], "result.nc").lattice is not None
