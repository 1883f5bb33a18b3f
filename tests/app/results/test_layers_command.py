"""`svwfs layers` on a recording and on a results file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from support.command_line import run

from app.bench.config import load_bench
from app.errors import InputError
from app.results.layers.dataset import distance_m, ratio_at
from app.results.layers.figure import layers_figure
from simulated_devices.sample import make_sample

DISTANCE_M = 0.195  # of the screen in small_demo


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("layers") / "run"
    with pytest.MonkeyPatch.context() as monkeypatch:
        assert run(monkeypatch, "measure", "--bench", "small_demo", "--frames", "1", "--out", folder) == 0
    return folder


@pytest.mark.parametrize("kind", ["recording", "result"])
def test_layer_is_found(recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str) -> None:
    source = recording if kind == "recording" else recording / "results.nc"
    out, plot = tmp_path / "layers.nc", tmp_path / "layers.png"
    assert run(monkeypatch, "layers", source, "--out", out, "--plot", plot) == 0
    assert plot.stat().st_size > 10_000
    with xr.open_dataset(out, engine="h5netcdf") as found:
        assert found["distance_m"].values == pytest.approx([DISTANCE_M], rel=0.02)
        assert 1e-4 < found["distance_sigma_m"].item() < 0.01
        assert found.attrs["verdict"] == "one layer"
        best_m = found["distance"][int(found["misfit"].argmin("distance"))]
        assert abs(best_m - DISTANCE_M) < 0.02
        assert found["chi_square"].dims == ("distance",)
        assert found["layer_phase"].dims == ("layer", "y", "x")
        phase = found["layer_phase"].isel(layer=0).load()
    bench = load_bench("small_demo")
    screen = make_sample(bench.simulation, bench.sensor, bench.field).screen
    inner = phase.where((abs(phase.x) < 1.9e-3) & (abs(phase.y) < 1.9e-3), drop=True)
    true = screen.at(inner.x.values, inner.y.values[:, None])
    difference = inner.values - true
    assert np.std(difference) < 0.05 * np.std(true)


def test_distances_from_the_mask_and_given_ones(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "layers.nc"
    assert run(monkeypatch, "layers", recording, "--from", "mask", "--distance", "0.1", "--out", out) == 0
    assert "layer at 100.0 mm from the mask" in capsys.readouterr().out
    with xr.open_dataset(out, engine="h5netcdf") as found:
        assert np.isnan(found["distance_sigma_m"].item())
        # s = u d / f1 + x (1 - d / f1)
        assert found.x.max().item() == pytest.approx(0.5 * 1.75e-3 + 0.5 * 0.6e-3)
        figure = layers_figure(found)
    assert len(figure.axes) == 5


def test_distances_and_ratios_belong_together() -> None:
    bench = load_bench("small_demo")  # f1 = 0.2 m
    assert ratio_at(0.1, "lenslets", bench) == pytest.approx(0.5)
    assert ratio_at(0.02, "mask", bench) == pytest.approx(9.0)
    for origin in ("lenslets", "mask"):
        assert distance_m(ratio_at(0.13, origin, bench), origin, bench) == pytest.approx(0.13)
    for distance, origin in ((-0.1, "lenslets"), (np.nan, "lenslets"), (0.0, "mask"), (0.3, "mask")):
        with pytest.raises(InputError, match="lies outside the bench"):
            ratio_at(distance, origin, bench)  # type: ignore[arg-type] # a name


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--distance", "-1"], "lies outside the bench"),
        (["--distance", "0.1", "--distance", "0.1"], "two different distances"),
        (["--distance", "1", "--distance", "2", "--distance", "3"], "at most two"),
        (["--frame", "7"], "has 1 frames"),
        (["--plot", "layers.xyz"], "picture"),
        (["--out", "results.nc"], "exists already"),
    ],
)
def test_bad_input_is_one_line(
    recording: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    sentence: str,
) -> None:
    (tmp_path / "results.nc").touch()
    monkeypatch.chdir(tmp_path)
    assert run(monkeypatch, "layers", recording, "--out", "layers.nc", *arguments) == 2
    last = capsys.readouterr().err.strip().splitlines()[-1]
    assert sentence in last
    assert not (tmp_path / "layers.nc").exists()
