"""`svwfs reconstruct` of spots in files, with a bench that names no method."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile
import xarray as xr
from support.command_line import run
from support.spots import SpotBench

from app.bench.config import Bench, save_bench
from reconstruction.settings import ReconstructionSettings
from simulated_devices.settings import SimulatedCameraSettings

BENCH = SpotBench()
MOVED_PX = np.array([1.37, -0.61])


@pytest.fixture
def files(tmp_path: Path) -> list[str | Path]:
    """Frame and reference of 8 bits in photon noise, and their bench, as arguments."""
    rng = np.random.default_rng(1)
    for name, moved_px in (("frame", MOVED_PX), ("reference", np.zeros(2))):
        light = BENCH.image(moved_px, sigma_px=1.2, light=1500.0)
        tifffile.imwrite(tmp_path / f"{name}.tif", rng.poisson(light + 10).clip(0, 255).astype(np.uint8))
    few = ReconstructionSettings(pupil_modes=6)
    save_bench(tmp_path / "bench.toml", Bench(sensor=BENCH.sensor, field=BENCH.field, reconstruction=few))
    reference, bench = ("--reference", tmp_path / "reference.tif"), ("--bench", tmp_path / "bench.toml")
    return [tmp_path / "frame.tif", *reference, *bench, "--out", tmp_path / "r.nc"]


def test_spots_are_recognised_and_their_tilt_is_right(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, files: list[str | Path]
) -> None:
    assert run(monkeypatch, "reconstruct", *files, "--set", "camera.bits=8") == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert "registration: centroids, because each lenslet of the reference shows one spot (sigma 1.2 px)" in shown
    assert "144 of 144 lenslets valid" in shown
    with xr.open_dataset(tmp_path / "r.nc") as result:
        found, sigma = (result[name].values[:, :, 0] for name in ("displacement", "displacement_sigma"))
        assert 0.60 < np.mean(np.abs(found - MOVED_PX) < sigma) < 0.76
        assert np.abs((found - MOVED_PX).mean(axis=(0, 1))).max() < 4 * sigma.mean() / 12
    assert run(monkeypatch, "reconstruct", *files, "--overwrite", "--set", "registration.method=centroids") == 0
    assert "registration:" not in capsys.readouterr().out


def test_scale_below_the_offset_is_refused_by_the_simulated_camera_alone(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, small_toml: Path
) -> None:
    assert replace(SimulatedCameraSettings(), bits=8).offset_counts == 500
    assert run(monkeypatch, "simulate", "--bench", small_toml, "--set", "camera.bits=8", "--out", tmp_path / "o") == 1
    assert "camera.offset_counts = 500 must be below 256" in capsys.readouterr().err
