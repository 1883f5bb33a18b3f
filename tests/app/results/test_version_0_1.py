"""Files written by version 0.1 still open and mean the same."""

from __future__ import annotations

import csv
import re
import shutil
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import tifffile
import xarray as xr
from support.command_line import run

from app.acquisition.devices import open_devices
from app.bench.config import Bench, load_bench, parse_bench, write_bench
from app.bench.device_kinds import RecordingSettings
from app.errors import InputError
from app.recording.reader import Recording
from app.recording.reprocess import reprocess
from app.results.dataset import result_dataset, results_in_pieces
from app.results.opened_recording import OpenedRecording
from app.results.result_file import write_pieces
from reconstruction.runtime.threads import one_blas_thread

FILES = Path(__file__).parents[2] / "support" / "version_0_1"
RECORDING = FILES / "recording"
FRAMES = 4
NOTICE = "recorded by version 0.1 or 0.2 with neglected propagation of light, and reconstructed so again"


def test_bench_of_0_1_loads_with_all_its_settings() -> None:
    bench = load_bench(FILES / "bench.toml")
    assert (bench.sensor.lenslet_rows, bench.sensor.lenslet_columns) == (3, 4)
    assert bench.lattice is not None
    assert bench.lattice.rotation_rad == 0.003
    assert bench.reconstruction.refine
    then, now = tomllib.loads((FILES / "bench.toml").read_text()), tomllib.loads(write_bench(bench))
    assert then["registration"].pop("conserve_flux")
    assert then["registration"].pop("flow") == "views"  # only the non-rigid methods read it
    assert now["field"]["neglect_propagation"]
    assert has_all(now, then)


def has_all(now: dict[str, Any], then: dict[str, Any]) -> bool:
    """True if all settings of then are the same now; there may be more."""
    return all(has_all(now[key], old) if isinstance(old, dict) else now[key] == old for key, old in then.items())


def as_in_0_1(bench: Bench) -> Bench:
    """The bench with what version 0.1 did before there were settings for it.

    Subimages could rotate, there was no response, and no search for layers; `conserve_flux` neglects propagation.
    """
    registration = replace(bench.registration, rotation=True, warp=bench.registration.warp or "quadratic")
    reconstruction = replace(bench.reconstruction, response=False, sample="free")
    return replace(bench, registration=registration, reconstruction=reconstruction)


def test_bench_of_0_1_by_itself_has_the_present_defaults() -> None:
    assert not load_bench(FILES / "bench.toml").registration.rotation


def test_recorded_bench_without_the_key_could_rotate() -> None:
    text = (FILES / "bench.toml").read_text()
    assert parse_bench(text, "recorded", is_recorded=True) == as_in_0_1(parse_bench(text, "by hand"))
    start, end = text.index("[registration]"), text.index("[reconstruction]")
    assert parse_bench(text[:start] + text[end:], "recorded", is_recorded=True).registration.rotation
    with pytest.raises(InputError, match="registration"):
        parse_bench("registration = 3\n" + text[:start] + text[end:], "recorded", is_recorded=True)


@pytest.mark.parametrize("rotation", [True, False])
def test_recorded_bench_of_today_says_whether_it_could_rotate(*, rotation: bool) -> None:
    bench = load_bench(FILES / "bench.toml", (f"registration.rotation={str(rotation).lower()}",))
    assert parse_bench(write_bench(bench), "recorded", is_recorded=True) == bench


@pytest.mark.slow
def test_results_beside_a_recording_of_0_1_are_its_own(tmp_path: Path) -> None:
    shutil.copytree(RECORDING, tmp_path / "r")
    with one_blas_thread():
        pieces = results_in_pieces(
            (made, {"mark": ((), np.array(7.0), {})}) for made in reprocess(Recording(RECORDING))
        )
        write_pieces(tmp_path / "r/results.nc", pieces, bench=load_bench(FILES / "bench.toml"), inputs={})
    with h5py.File(tmp_path / "r/results.nc", "r+") as file:
        file.attrs["bench"] = (FILES / "bench.toml").read_text()  # as version 0.1 wrote it: without the key
        del file["crc32"]
    assert OpenedRecording(tmp_path / "r").results()["mark"].values.tolist() == [7.0] * FRAMES


def test_recording_with_a_non_rigid_method_opens_and_is_reconstructed_with_another(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "r"
    shutil.copytree(RECORDING, folder)
    for file in (folder / "run.json", folder / "calibrations/0/bench.toml"):
        file.write_text(re.sub(r'(\\?")gauss_newton\1', r"\1demons\1", file.read_text()))
    recording = Recording(folder)
    assert str(recording.bench.registration.method) == "demons"
    assert parse_bench(write_bench(recording.bench), "again", is_recorded=True) == recording.bench
    assert len(OpenedRecording(folder)) == FRAMES
    assert run(monkeypatch, "replay", folder) == 2
    said = capsys.readouterr().err
    assert "there is no registration method demons: it must be one of gauss_newton, " in said
    assert run(monkeypatch, "replay", folder, "--set", "registration.method=gauss_newton") == 0


def test_recording_of_0_1_opens() -> None:
    recording = Recording(RECORDING)
    assert (len(recording), recording.is_complete, recording.ended_early) == (FRAMES, True, "")
    assert recording.bench == as_in_0_1(load_bench(FILES / "bench.toml"))
    assert recording.calibration(0).bench.registration.rotation
    lines = [recording.line(index) for index in range(FRAMES)]
    assert [(line.camera_index, line.start, line.bias) for line in lines] == [
        (5, -1, 0),
        (6, 0, 0),
        (7, 1, 1),
        (8, 2, 1),
    ]
    assert {(line.is_light_on, line.light_current_a, line.problem, line.valid) for line in lines} == {
        (True, 0.35, "", 12)
    }
    start, displacement = recording.start(0), recording.displacement(3)
    assert start is not None
    assert displacement is not None
    assert start.shape == displacement.shape == recording.bias(1).shape == (3, 4, 6, 2)
    frame = recording.frame(2)
    assert (frame.pixels.shape, frame.exposure_s, frame.em_gain, frame.index) == ((84, 108), 0.02, 4.0, 7)
    np.testing.assert_array_equal(
        frame.pixels, np.fromfile(RECORDING / "frames.zarr/0/c/2/0/0", "<u2").reshape(84, 108)
    )


def test_replay_repeats_the_results_of_0_1() -> None:
    recording = Recording(RECORDING)
    with one_blas_thread():
        for made in reprocess(recording):
            assert made.registered is not None
            assert made.wavefront is not None
            now = made.registered.coefficients, made.wavefront.coefficients
            then = recording.displacement(made.index), recording.coefficients(made.index)
            for value, expected in zip(now, then, strict=True):
                assert value is not None
                assert expected is not None
                np.testing.assert_allclose(value, expected, rtol=0, atol=0.05)  # pixels are weighted otherwise


def test_verification_names_the_other_version(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, "replay", RECORDING, "--verify") == 1
    assert f"{FRAMES} of {FRAMES} frames differ from what was recorded" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize(
    "words",
    [
        ("replay", RECORDING),
        ("replay", RECORDING, "--set", "reconstruction.method=zonal"),
        ("layers", RECORDING, "--out", "r.nc"),
        ("layers", FILES / "result.nc", "--out", "r.nc"),
        ("corrector", RECORDING, "--out", "r.nc"),
        ("field", RECORDING, "--out", "r.nc"),
        ("export", RECORDING, "--to", "csv", "--out", "r.csv"),
        ("report", RECORDING, "--out", "r.pdf"),
    ],
)
def test_every_command_says_that_propagation_was_neglected(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, words: tuple[Any, ...]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(monkeypatch, *words) == 0
    assert f"{words[1]}: {NOTICE}" in capsys.readouterr().out


def test_notice_is_left_out_where_propagation_is_not_neglected(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert run(monkeypatch, "replay", RECORDING, "--set", "field.neglect_propagation=false") == 0
    assert run(monkeypatch, "export", RECORDING, "--to", "tiff", "--out", tmp_path / "r.tif") == 0
    assert NOTICE not in capsys.readouterr().out


def test_recording_of_0_1_plays_as_a_camera() -> None:
    camera = RecordingSettings(folder=str(RECORDING), pace="fastest")
    recording = Recording(RECORDING)
    with open_devices(replace(load_bench(FILES / "bench.toml"), camera=camera), lambda _: None) as devices:
        devices.camera.start()
        dark = devices.camera.read(1).pixels
        devices.light.set_on(True)
        reference = devices.camera.read(1).pixels
        devices.stage.set_sample_in(True)
        frames = [devices.camera.read(1).pixels for _ in range(FRAMES)]
    assert dark.mean() == pytest.approx(recording.calibration(0).dark.mean.mean(), abs=2)  # type: ignore[union-attr] # it has a dark
    assert reference.mean() == pytest.approx(recording.calibration(0).reference.mean.mean(), abs=2)
    np.testing.assert_array_equal(frames, [recording.pixels(index) for index in range(FRAMES)])


@pytest.mark.slow
def test_recording_of_0_1_is_exported(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    recording = Recording(RECORDING)
    for form, name in (("tiff", "r.tif"), ("csv", "r.csv"), ("netcdf", "r.nc"), ("psf", "psf.tif")):
        assert run(monkeypatch, "export", RECORDING, "--to", form, "--out", tmp_path / name) == 0
    np.testing.assert_array_equal(tifffile.imread(tmp_path / "r.tif"), [recording.pixels(at) for at in range(FRAMES)])
    assert tifffile.imread(tmp_path / "psf.tif").sum(axis=(1, 2)) == pytest.approx(np.ones(9), rel=1e-5)
    with (tmp_path / "r.csv").open() as file:
        rows = list(csv.DictReader(file))
    with xr.open_dataset(tmp_path / "r.nc") as results:
        for at, row in enumerate(rows):
            expected = recording.coefficients(at)
            assert expected is not None
            assert float(row["e_5_2_rad"]) == float(results["coefficients"][at, 5, 2])
            np.testing.assert_allclose(results["coefficients"][at], expected, rtol=0, atol=0.05)


@pytest.mark.slow
@pytest.mark.long
def test_recording_of_0_1_is_reported(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert run(monkeypatch, "report", RECORDING, "--out", tmp_path / "r.pdf") == 0
    assert f"the report of {FRAMES} frames is in" in capsys.readouterr().out
    assert (tmp_path / "r.pdf").read_bytes().count(b"/Type /Page ") == 3


def test_damage_in_a_recording_of_0_1_is_found(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    shutil.copytree(RECORDING, tmp_path / "r")
    (tmp_path / "r/frames.zarr/0/c/1/0/0").unlink()
    assert run(monkeypatch, "recover", tmp_path / "r") == 0
    assert "frame 1: the pixels are missing" in capsys.readouterr().out


def schema(dataset: xr.Dataset) -> dict[Any, Any]:
    """Dimensions, kind of number and unit of each variable."""
    return {name: (each.dims, each.dtype.kind, each.attrs.get("units")) for name, each in dataset.variables.items()}


def test_result_of_0_1_has_the_names_dimensions_and_units_of_today() -> None:
    with one_blas_thread():
        wavefront = next(iter(reprocess(Recording(RECORDING)))).wavefront
    assert wavefront is not None
    today = result_dataset(wavefront, with_psf=True)
    with xr.open_dataset(FILES / "result.nc") as result:
        assert result.attrs["software"] == "svwfs 0.1.0"
        assert (result.attrs["frame"], result.attrs["dark"]) == ("frame.tif", "dark.tif")
        assert parse_bench(result.attrs["bench"], "result.nc").field.view_columns == 2
        then, now = schema(result), schema(today)
        rotation = {"rotation", "rotation_sigma", "rotation_significance", "circulation_chi_square"}
        layers = {"contradicts_layers", "assumed_layers", "layer_distance", "layer_distance_sigma"}
        light = {"transmission", "transmission_sigma"}
        assert now == then | {name: now[name] for name in rotation | layers | light}  # what is reported since 0.1
        np.testing.assert_allclose(
            result["rms"], result["wavefront"].std(dim=("lenslet_row", "lenslet_column")), rtol=1e-12
        )
