"""`svwfs field` on a recording and on results, and Zernike exports of a recording."""

from __future__ import annotations

import csv
import os
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from support.command_line import run
from support.pictures import assert_drawn
from support.recordings import record

from app.bench.config import Bench, load_bench
from reconstruction.arrays import Floats
from reconstruction.modes.polynomials import zernike
from reconstruction.wavefront import without_piston

RADIUS_M, HALF_WIDTH_M = 3.5 * 0.5e-3, 0.6e-3  # of small_demo's pupil and field


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("field") / "run"
    with pytest.MonkeyPatch.context() as monkeypatch:
        assert run(monkeypatch, "measure", "--bench", "small_demo", "--frames", "2", "--out", folder) == 0
    return folder


def at_views(coefficients: Floats, bench: Bench) -> Floats:
    """Wavefronts (view_row, view_column, lenslet_row, lenslet_column) of Zernike coefficients (mode, y, x)."""
    x, y = bench.sensor.pupil_x_m / RADIUS_M, bench.sensor.pupil_y_m[:, None] / RADIUS_M
    return np.asarray(np.tensordot(np.moveaxis(coefficients, 0, -1), zernike(len(coefficients) + 1, x, y)[1:], axes=1))


def read(path: Path) -> list[dict[str, float]]:
    with path.open(newline="") as file:
        return [{name: float(value) for name, value in row.items()} for row in csv.DictReader(file)]


@pytest.mark.slow
@pytest.mark.long
def test_maps_are_the_wavefront_of_the_results(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out, plot = tmp_path / "field.nc", tmp_path / "field.png"
    assert run(monkeypatch, "field", recording, "--frame", "1", "--out", out, "--plot", plot) == 0
    assert_drawn(plot)
    assert capsys.readouterr().out.count("over the field") == 6
    with xr.open_dataset(recording / "results.nc") as results, xr.open_dataset(out) as found:
        assert found["coefficient"].dims == ("mode", "y", "x")
        assert found["coefficient"].attrs["units"] == found["double_zernike"].attrs["units"] == "rad"
        assert found["mode"].values.tolist() == list(range(2, 67))
        assert found.sel(mode=4)["name"].item() == "Z4 defocus"
        views = found["coefficient"].interp(x=results["view_x"].values, y=results["view_y"].values, method="cubic")
        made = without_piston(at_views(views.values, load_bench("small_demo")))
        np.testing.assert_allclose(made, results["wavefront"].values[1], atol=2e-3)  # interpolated
        # Double Zernikes at the middle of the field: Z_k(0, 0) Z_j
        at_middle = zernike(len(found["k"]) - 1, 0.0, 0.0) @ found["double_zernike"].values[1:, 2:]
        np.testing.assert_allclose(at_middle, found["coefficient"].sel(x=0, y=0).values, atol=1e-12)
        assert (found.attrs["uv_outer"], found.attrs["xy_outer"]) == pytest.approx((HALF_WIDTH_M, RADIUS_M))


@pytest.mark.slow
def test_results_file_gives_the_same_values_and_nearly_the_errors(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, source in (("run", recording), ("result", recording / "results.nc")):
        assert run(monkeypatch, "field", source, "--degree", "4", "--out", tmp_path / f"{name}.nc") == 0
    with xr.open_dataset(tmp_path / "run.nc") as one, xr.open_dataset(tmp_path / "result.nc") as other:
        np.testing.assert_allclose(one["coefficient"], other["coefficient"], atol=1e-12)
        np.testing.assert_allclose(one["double_zernike"], other["double_zernike"], atol=1e-12)
        ratio = np.sqrt(
            (other["coefficient_sigma"] ** 2).mean(("x", "y")) / (one["coefficient_sigma"] ** 2).mean(("x", "y"))
        )
        np.testing.assert_allclose(ratio, 1, atol=0.25)


@pytest.mark.slow
def test_table_has_a_row_for_each_position(recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out, maps = tmp_path / "t.csv", tmp_path / "t.nc"
    options = ("--positions", "3", "--basis", "legendre", "--degree", "2")
    assert run(monkeypatch, "field", recording, *options, "--out", out) == 0
    assert run(monkeypatch, "field", recording, *options, "--out", maps) == 0
    rows = read(out)
    modes = [f"L{k}" for k in range(1, 6)]
    assert list(rows[0]) == ["x_m", "y_m", *(f"{mode}_rad" for mode in modes), *(f"{mode}_sigma_rad" for mode in modes)]
    assert [row["x_m"] for row in rows] == pytest.approx([-HALF_WIDTH_M, 0, HALF_WIDTH_M] * 3)
    assert [row["y_m"] for row in rows[::3]] == pytest.approx([-HALF_WIDTH_M, 0, HALF_WIDTH_M])
    with xr.open_dataset(maps) as found:
        assert "double_zernike" not in found
        assert [row["L3_rad"] for row in rows] == found["coefficient"].sel(mode=3).values.ravel().tolist()
        assert [row["L5_sigma_rad"] for row in rows] == found["coefficient_sigma"].sel(mode=5).values.ravel().tolist()


@pytest.mark.slow
def test_exports_hold_every_frame(recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    double, table = tmp_path / "d.nc", tmp_path / "t.csv"
    assert run(monkeypatch, "export", recording, "--to", "double-zernike", "--out", double) == 0
    assert run(monkeypatch, "export", recording, "--to", "zernike-table", "--out", table) == 0
    rows = read(table)
    assert [row["frame"] for row in rows] == [0] * 9 + [1] * 9
    with xr.open_dataset(double) as found, xr.open_dataset(recording / "results.nc") as results:
        assert found["double_zernike"].dims == ("frame", "k", "j")
        assert found["recording_index"].values.tolist() == [0, 1]
        for row in rows:
            at = zernike(
                len(found["k"]) - 1, row["x_m"] / found.attrs["uv_outer"], row["y_m"] / found.attrs["uv_outer"]
            )
            expected = at @ found["double_zernike"].values[int(row["frame"]), 1:]
            assert [row[f"Z{j}_rad"] for j in range(2, 67)] == pytest.approx(expected[2:].tolist(), abs=1e-12)
        coefficients = np.array([[row[f"Z{j}_rad"] for j in range(2, 67)] for row in rows]).reshape(2, 3, 3, 65)
        made = without_piston(at_views(np.moveaxis(coefficients[1], -1, 0), load_bench("small_demo")))
        np.testing.assert_allclose(made, results["wavefront"].values[1], atol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--degree", "40"], "degree 40 of the pupil modes must be 1 ... 10"),
        (["--field-order", "9"], "field order 9 exceeds that of the"),
        (["--field-order", "1", "--basis", "legendre"], "leave it out with --basis legendre"),
        (["--frame", "7"], "there is no frame 7; frames are counted from 0, their number is 2"),
        (["--mode", "1"], "--mode 1: the zernike modes of this result are 2 ... 66"),
        (["--out", "f.txt"], "ends in one of .nc, .csv"),
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
    monkeypatch.chdir(tmp_path)
    out = () if "--out" in arguments else ("--out", "f.nc")
    assert run(monkeypatch, "field", recording / "results.nc", *out, *arguments) == 2
    assert sentence in capsys.readouterr().err.strip().splitlines()[-1]
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
@pytest.mark.long
def test_sources_without_the_coefficients_are_refused(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refused(*arguments: str | Path, out: Path = tmp_path / "f.nc") -> str:
        assert run(monkeypatch, *arguments, "--out", out) == 2
        assert not out.exists()
        return capsys.readouterr().err.strip().splitlines()[-1]

    assert "no such file" in refused("field", tmp_path / "nothing.nc")
    assert "null: not a file" in refused("field", Path(os.devnull))
    with xr.open_dataset(recording / "results.nc") as results:
        results.assign(wavefront=results["wavefront"] * np.nan).to_netcdf(tmp_path / "lost.nc")
    assert "no lenslet is known inside the pupil 3.50 mm" in refused("field", tmp_path / "lost.nc")


@pytest.mark.slow
@pytest.mark.long
def test_zonal_results_have_the_coefficients_of_their_views(
    small_toml: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A least-squares fit of 36 modes by SciPy at the lenslet centres in the circle; between views they interpolate."""
    zonal = record(small_toml, tmp_path / "zonal", "reconstruction.method=zonal", frames=1).folder
    results, table = tmp_path / "r.nc", tmp_path / "t.csv"
    assert run(monkeypatch, "export", zonal, "--to", "netcdf", "--out", results) == 0
    for source, out in ((zonal, tmp_path / "one.nc"), (results, tmp_path / "other.nc")):
        assert run(monkeypatch, "field", source, "--positions", "3", "--out", out) == 0
    assert run(monkeypatch, "export", zonal, "--to", "zernike-table", "--order", "fringe", "--out", table) == 0
    bench = load_bench(str(small_toml))
    radius_m = min(bench.sensor.pupil_half_width_m)
    x, y = bench.sensor.pupil_x_m / radius_m, bench.sensor.pupil_y_m[:, None] / radius_m
    with xr.open_dataset(results) as stored, xr.open_dataset(tmp_path / "other.nc") as between:
        views = stored["wavefront"].values[0]
        known = np.isfinite(views).all(axis=(0, 1)) & (x**2 + y**2 <= 1)
        modes = zernike(len(between["mode"]) + 1, x, y)[:, known]
        expected = np.moveaxis(np.linalg.lstsq(modes.T, views[..., known].reshape(9, -1).T)[0].reshape(-1, 3, 3), 0, -1)
        at_views = between["coefficient"].interp(x=stored["view_x"].values, y=stored["view_y"].values)
        assert between["coefficient_sigma"].isnull().all()
        np.testing.assert_allclose(at_views.transpose("y", "x", "mode")[1, 1], expected[1, 1, 1:], atol=1e-9)
        with xr.open_dataset(tmp_path / "one.nc") as one:  # the recording has all field modes
            np.testing.assert_allclose(one["coefficient"][:, 1, 1], expected[1, 1, 1:], atol=1e-9)
    defocus = [row["Z4_rad"] / np.sqrt(3) for row in read(table)]
    np.testing.assert_allclose(defocus, expected[..., 3].ravel(), atol=1e-9)
