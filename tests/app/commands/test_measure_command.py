"""The command measure: results, recordings that end early, and what it says of them."""

from __future__ import annotations

import itertools
import json
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tifffile
import xarray as xr
from support.command_line import run
from support.patience import HANG_S, wait_until
from support.simulated_scene import unplug

from app.acquisition.devices import open_devices
from app.acquisition.session import LiveBench
from app.bench.config import Bench
from app.errors import Interrupted, RunError
from app.measurement.averages import FRAMES
from drivers.interface import Devices, Disconnected, Frame
from simulated_devices.camera import SimulatedCamera


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.usefixtures("no_hurry")
def test_measure_writes_results(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, small_toml: Path
) -> None:
    assert (
        run(monkeypatch, "measure", "--bench", small_toml, "--frames", "5", "--out", tmp_path / "m", "--auto-expose")
        == 0
    )
    with xr.open_dataset(tmp_path / "m" / "results.nc") as results:
        assert results["wavefront"].shape == (5, 3, 3, 5, 7)
        rms_rad = results["rms"].mean(["view_row", "view_column"]).to_numpy()
        assert rms_rad == pytest.approx(1.5, rel=0.1)  # RMS of the bench's screen
        assert results["frame_index"].to_numpy().tolist() == list(range(5))
    line = json.loads((tmp_path / "m" / "frames.jsonl").read_text().splitlines()[-1])
    said = capsys.readouterr().out
    assert "5 frames, 0 lost by the camera" in said
    assert f"exposure {line['exposure_s'] * 1e3:.4g} ms, light current {line['light_current_a']:.4g} A" in said
    assert "camera and light are simulated" in said
    assert tifffile.imread(tmp_path / "m" / "reference.tif").shape == (172, 240)
    record = json.loads((tmp_path / "m" / "run.json").read_text())
    assert record["frames"] == {"acquired": 5, "recorded": 5, "reconstructed": 5, "lost": 0}
    assert record["timings"]["register"]["count"] >= 5
    assert 0 < record["timings"]["register"]["p50_s"] <= record["timings"]["to_result"]["max_s"]
    assert record["timings"]["draw"] == {"count": 0, "p50_s": None, "p99_s": None, "max_s": None}
    assert {"python", "numpy", "numba"} <= set(record["versions"])


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.usefixtures("no_hurry")
def test_measure_that_recorded_nothing_can_be_repeated(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, small_toml: Path
) -> None:
    def fail(*_: object) -> None:
        raise Disconnected("the camera is gone")

    command = ("measure", "--bench", small_toml, "--frames", "3", "--out", tmp_path / "m")
    with monkeypatch.context() as unplugged:
        unplugged.setattr(LiveBench, "_start_camera", fail)
        assert run(monkeypatch, *command) == 1
    assert "the camera is gone" in capsys.readouterr().err
    assert not (tmp_path / "m").exists()
    assert run(monkeypatch, *command) == 0


@pytest.mark.slow
def test_interrupted_measure_names_folder_of_frames(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, small_toml: Path
) -> None:
    def interrupt(*_: object, **__: object) -> None:
        raise Interrupted("interrupted")

    monkeypatch.setattr("app.results.run_summary.write_pieces", interrupt)
    assert run(monkeypatch, "measure", "--bench", small_toml, "--frames", "3", "--out", tmp_path / "m") == 130
    assert "m holds 3 frames; svwfs replay" in capsys.readouterr().err.replace("\n", " ")
    assert not (tmp_path / "m" / "results.nc").exists()


@pytest.mark.slow
def test_measure_on_full_disk_names_folder_of_frames(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, small_toml: Path
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise RunError("results.nc: cannot be written: no space left")

    monkeypatch.setattr("app.results.run_summary.write_pieces", refuse)
    assert run(monkeypatch, "measure", "--bench", small_toml, "--frames", "3", "--out", tmp_path / "m") == 1
    said = capsys.readouterr().err.replace("\n", " ")
    assert "no space left" in said
    assert "m holds 3 frames; svwfs replay" in said


@pytest.mark.slow
@pytest.mark.long
def test_measure_refines_every_frame(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, small_toml: Path) -> None:
    command = ("measure", "--bench", small_toml, "--frames", "5", "--out", tmp_path / "m")
    assert run(monkeypatch, *command, "--set", "reconstruction.refine=true") == 0
    with xr.open_dataset(tmp_path / "m" / "results.nc") as results:
        assert np.all(results["bias_age"].to_numpy() >= 0)


@pytest.mark.slow
@pytest.mark.long
def test_ctrl_c_saves_measured_frames(tmp_path: Path, small_toml: Path) -> None:
    command = [sys.executable, "-c", "from app.cli import main; main()", "measure", "--bench", str(small_toml)]
    process = subprocess.Popen(  # noqa: S603 - our own program
        [*command, "--frames", "100000", "--out", str(tmp_path / "m")], stderr=subprocess.PIPE, text=True
    )
    lines = tmp_path / "m" / "frames.jsonl"
    wait_until(lambda: lines.exists() and lines.read_text().count("\n") >= 3)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=HANG_S)
    assert process.returncode == 130
    said = re.search(r"svwfs: stopped: (\d+) of 100000 frames are in", errors)
    assert said is not None
    with xr.open_dataset(tmp_path / "m" / "results.nc") as results:
        assert results.sizes["frame"] == int(said[1]) > 0


@pytest.mark.slow
@pytest.mark.long
def test_unplugged_camera_keeps_measured_frames(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, small_toml: Path
) -> None:
    def open_then_unplug(bench: Bench, progress: Callable[[float], None]) -> Devices:
        devices = open_devices(bench, progress)
        camera, read = devices.camera, devices.camera.read
        assert isinstance(camera, SimulatedCamera)
        left = itertools.count(2 * FRAMES + 5, -1)  # frames until it is unplugged

        def read_while_plugged(timeout_s: float) -> Frame:
            frame = read(timeout_s)
            if next(left) == 0:
                unplug(camera)
            return frame

        monkeypatch.setattr(camera, "read", read_while_plugged)
        return devices

    monkeypatch.setattr("app.acquisition.devices.open_devices", open_then_unplug)
    assert run(monkeypatch, "measure", "--bench", small_toml, "--frames", "50", "--out", tmp_path / "m") == 1
    errors = capsys.readouterr().err
    assert "svwfs: " in errors
    assert "camera" in errors
    assert "Traceback" not in errors
    with xr.open_dataset(tmp_path / "m" / "results.nc") as results:
        assert results.sizes["frame"] in {5, 6}


def test_measure_without_light_fails_with_a_reason(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, small_toml: Path
) -> None:
    command = ("measure", "--bench", small_toml, "--frames", "3", "--out", tmp_path / "m")
    assert run(monkeypatch, *command, "--set", "light.current_a=0.0") == 1
    assert "was the light on" in capsys.readouterr().err
    assert not (tmp_path / "m" / "results.nc").exists()
