"""Exported files, read back and compared with the recording."""

from __future__ import annotations

import json
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
import tifffile
import xarray as xr
from numpy.typing import NDArray
from scipy.integrate import quad
from support.optics import FIELD, sensor_of
from support.recordings import record, replace_pixels

from app.bench.config import parse_bench
from app.errors import Interrupted, RunError
from app.progress import Progress
from app.recording.reader import Recording
from app.results import dataset
from app.results.export import Format, export_recording
from app.results.point_spread import psf_grid, psf_reach, write_psf_grid
from reconstruction.arrays import Floats
from reconstruction.quality.image_quality import diffraction_rad
from reconstruction.solve.modal import ModalSolution
from reconstruction.wavefront import rms

SENSOR = sensor_of(7, 9)


@pytest.fixture(scope="module")
def recording(small_toml: Path, tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return record(small_toml, tmp_path_factory.mktemp("recording") / "run", frames=9)


@pytest.fixture(scope="module")
def zonal(small_toml: Path, tmp_path_factory: pytest.TempPathFactory) -> Recording:
    folder = tmp_path_factory.mktemp("recording") / "zonal"
    return record(small_toml, folder, "reconstruction.method=zonal", frames=2)


def exported(
    recording: Recording, to: Format, out: Path, frames: str | None = None, progress: Progress = lambda *_: None
) -> Path:
    export_recording(recording.folder, to, out, frames, progress)
    return out


def read_table(path: Path) -> NDArray[np.void]:
    return np.atleast_1d(np.genfromtxt(path, delimiter=",", names=True))


def names_of(table: NDArray[np.void]) -> tuple[str, ...]:
    assert table.dtype.names is not None
    return table.dtype.names


def test_tiff_is_an_imagej_film(recording: Recording, tmp_path: Path) -> None:
    with tifffile.TiffFile(exported(recording, "tiff", tmp_path / "run.tif")) as file:
        assert file.is_bigtiff
        assert file.is_imagej
        assert file.imagej_metadata is not None
        metadata = file.imagej_metadata
        assert (file.series[0].axes, len(file.pages)) == ("TYX", 9)
        pixels = file.asarray()
        resolution = file.pages.first.tags["XResolution"].value
    np.testing.assert_array_equal(pixels, [recording.pixels(index) for index in range(9)])
    assert pixels.dtype == np.uint16
    lines = [recording.line(index) for index in range(9)]
    for line, label in zip(lines, metadata["Labels"], strict=True):
        assert label == f"frame {line.index}: t = {line.camera_time_s:.6f} s, exposure 20 ms, em gain 8"
    times_s = np.array([line.camera_time_s for line in lines])
    assert metadata["finterval"] == pytest.approx(np.median(np.diff(times_s)))
    assert (metadata["images"], metadata["frames"], metadata["unit"]) == (9, 9, "um")
    assert resolution[1] / resolution[0] == pytest.approx(16.0)  # um a pixel
    assert parse_bench(metadata["Info"], "Info").lattice == recording.calibration(0).lattice


def test_selected_frames_are_exported(recording: Recording, tmp_path: Path) -> None:
    some = tifffile.imread(exported(recording, "tiff", tmp_path / "some.tif", frames="2:5"))
    np.testing.assert_array_equal(some, [recording.pixels(index) for index in (2, 3, 4)])
    one = tifffile.imread(exported(recording, "tiff", tmp_path / "one.tif", frames="-1:"))
    np.testing.assert_array_equal(one, recording.pixels(8))


def test_csv_equals_the_recorded_results(recording: Recording, tmp_path: Path) -> None:
    table = read_table(exported(recording, "csv", tmp_path / "run.csv"))
    expected = recording.calibration(0).reconstructor()
    assert len(table) == 9
    for index in range(9):
        row, line = table[index], recording.line(index)
        assert (row["frame"], row["camera_frame"], row["time_s"]) == (index, line.camera_index, line.camera_time_s)
        assert (row["exposure_s"], row["em_gain"], row["valid_lenslets"]) == (line.exposure_s, line.em_gain, line.valid)
        coefficients = recording.coefficients(index)
        assert coefficients is not None
        again = np.empty_like(coefficients)
        for mode in np.ndindex(again.shape):
            again[mode] = row[f"e_{mode[0]}_{mode[1]}_rad"]
        half_sigma_rad = 0.5 * row["e_0_1_sigma_rad"] if index == 0 else 0.0  # it may have started from a frame before
        np.testing.assert_allclose(again, coefficients, rtol=0, atol=half_sigma_rad)
        wavefront = expected(recording.pixels(index))
        assert isinstance(wavefront.solution, ModalSolution)
        assert row["rms_2_0_rad"] == pytest.approx(rms(wavefront.views)[2, 0], rel=1e-3)
        assert row["e_4_1_sigma_rad"] == pytest.approx(wavefront.solution.coefficients_sigma[4, 1], rel=1e-2)
    assert not any(np.isnan(table[name]).any() for name in names_of(table) if name != "clock_time")
    clock = np.genfromtxt(tmp_path / "run.csv", delimiter=",", names=True, dtype=None, encoding="utf-8")["clock_time"]
    began = datetime.fromisoformat(recording.run["began"])
    for index in range(9):
        elapsed_s = (datetime.fromisoformat(clock[index]) - began).total_seconds()
        assert elapsed_s == pytest.approx(recording.line(index).host_time_s - recording.run["began_host_s"], abs=2e-3)


def test_csv_of_zonal_method_has_no_coefficients(zonal: Recording, tmp_path: Path) -> None:
    table = read_table(exported(zonal, "csv", tmp_path / "run.csv"))
    assert list(names_of(table))[7:] == [f"rms_{row}_{column}_rad" for row in range(3) for column in range(3)]
    assert table["rms_0_0_rad"].mean() > 0.1


@pytest.mark.slow
@pytest.mark.long
def test_frame_without_wavefront_is_a_row_of_nan(tmp_path: Path, small_toml: Path) -> None:
    folder = tmp_path / "run"
    dark = record(small_toml, folder, frames=4)
    too_dark = np.full_like(dark.pixels(0), 500)
    replace_pixels(dark, 0, too_dark)
    table = read_table(exported(dark, "csv", tmp_path / "run.csv"))
    assert table["frame"].tolist() == [0, 1, 2, 3]
    assert table["valid_lenslets"][0] == 0
    for name in names_of(table)[7:]:
        assert np.isnan(table[name]).tolist() == [True, False, False, False]
    with xr.open_dataset(exported(dark, "netcdf", tmp_path / "run.nc")) as dataset:
        assert dataset["recording_index"].to_numpy().tolist() == [1, 2, 3]
    for index in range(1, 4):
        replace_pixels(dark, index, too_dark)
    formats: tuple[Format, ...] = ("csv", "netcdf", "psf")
    for to in formats:
        with pytest.raises(RunError, match="there is nothing to write: no frame has a wavefront"):
            exported(dark, to, tmp_path / "nothing")
    assert not (tmp_path / "nothing").exists()


@pytest.mark.slow
@pytest.mark.long
def test_netcdf_equals_the_recorded_results(
    recording: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dataset, "PIECE", 2)
    with xr.open_dataset(exported(recording, "netcdf", tmp_path / "run.nc", frames="1:6")) as results:
        for index in range(5):
            np.testing.assert_array_equal(results["coefficients"][index], recording.coefficients(index + 1))
            np.testing.assert_array_equal(results["displacement"][index], recording.displacement(index + 1))
        assert results["valid"].dtype == np.bool_
        assert results.attrs["recording"] == "run"


def test_psf_of_a_flat_pupil_equals_closed_form() -> None:
    """Closed form for a rectangle: sinc^2 along x times sinc^2 along y, also for the light within a square."""
    flat = np.zeros((1, 1, 7, 9))
    unit_rad = diffraction_rad(SENSOR)  # wavelength over the wider side
    grid = psf_grid([flat, flat], SENSOR, 6 * unit_rad)
    along = grid.angle_rad / unit_rad
    expected = np.sinc(along * 7 / 9)[:, None] ** 2 * np.sinc(along) ** 2
    expected /= expected.sum()
    np.testing.assert_allclose(grid.psf[0, 0], expected, atol=3e-3 * expected.max())
    assert grid.psf.sum() == pytest.approx(1)
    light = 4 * quad(lambda t: np.sinc(t) ** 2, 0, 6)[0] * quad(lambda t: np.sinc(t) ** 2, 0, 6 * 7 / 9)[0]
    assert grid.light[0, 0] == pytest.approx(light, rel=3e-3)


def test_psf_is_the_mean_over_frames() -> None:
    """Two frames with opposite tilt give two equal spots at the angles of the tilt."""
    angle_rad = 4 * diffraction_rad(SENSOR)
    tilt = SENSOR.wavenumber_rad_per_m * angle_rad * SENSOR.pupil_x_m * np.ones((1, 1, 7, 1))
    grid = psf_grid([tilt, -tilt], SENSOR, psf_reach([tilt, np.full_like(tilt, np.nan)], SENSOR))
    middle = len(grid.angle_rad) // 2
    row = grid.psf[0, 0, middle]
    peak = np.argmax(row[middle:]) + middle
    assert grid.angle_rad[peak] == pytest.approx(angle_rad, rel=0.05)
    np.testing.assert_allclose(row, row[::-1], rtol=1e-3, atol=1e-7)
    assert row[middle] < 0.02 * row[peak]


def test_unknown_view_is_left_out(tmp_path: Path) -> None:
    views = np.zeros((3, 3, 7, 9))
    views[0, 2] = np.nan
    grid = psf_grid([views], SENSOR, 5 * diffraction_rad(SENSOR))
    write_psf_grid(tmp_path / "psf.tif", grid, FIELD, {})
    with tifffile.TiffFile(tmp_path / "psf.tif") as file:
        assert file.imagej_metadata is not None
        places = json.loads(file.imagej_metadata["Info"])["views"]
        assert len(file.pages) == len(places) == 8
        assert file.imagej_metadata["Labels"][3] == "x = +0.000 mm, y = +0.000 mm"
        assert file.imagej_metadata["Labels"][4] == "x = +0.500 mm, y = +0.000 mm"
    at = {(place["view_row"], place["view_column"]): (place["x_m"], place["y_m"]) for place in places}
    assert (0, 2) not in at
    assert [at[0, 1], at[1, 2], at[2, 0]] == [(0, -0.5e-3), (0.5e-3, 0), (-0.5e-3, 0.5e-3)]
    assert not np.isnan(tifffile.imread(tmp_path / "psf.tif")).any()


@pytest.mark.slow
@pytest.mark.long
def test_exported_psf_grid_matches_recorded_wavefronts(recording: Recording, tmp_path: Path) -> None:
    bench = recording.bench
    with tifffile.TiffFile(exported(recording, "psf", tmp_path / "psf.tif")) as file:
        assert file.imagej_metadata is not None
        metadata, stack = file.imagej_metadata, file.asarray()
        resolution = file.pages.first.tags["XResolution"].value
    information = json.loads(metadata["Info"])
    assert stack.dtype == np.float32
    np.testing.assert_allclose(stack.sum(axis=(1, 2)), 1, rtol=1e-5)
    assert [(place["x_m"], place["y_m"]) for place in information["views"]] == [
        (x, y) for y in bench.field.view_y_m for x in bench.field.view_x_m
    ]
    assert metadata["Labels"][1] == "x = +0.000 mm, y = -0.500 mm"
    assert all(0.8 < place["light"] < 1.01 for place in information["views"])
    assert information["pixel_m"] == pytest.approx(information["pixel_rad"] * 0.2)  # the collimator's focal length
    assert resolution[1] / resolution[0] == pytest.approx(information["pixel_m"] * 1e6, rel=1e-3)
    # The centre of light is displaced by the mean slope of the view.
    reconstructor = recording.calibration(0).reconstructor()
    slopes = np.mean([_mean_slope_x(reconstructor(recording.pixels(i)).views[0, 1]) for i in range(9)])
    angle_rad = (np.arange(stack.shape[2]) - stack.shape[2] // 2) * information["pixel_rad"]
    middle_rad = float((stack[1] * angle_rad).sum())
    assert middle_rad == pytest.approx(
        slopes / bench.sensor.wavenumber_rad_per_m, abs=1.5 * diffraction_rad(bench.sensor)
    )


def _mean_slope_x(view: Floats) -> float:
    return float(np.nanmean(np.diff(view, axis=1)) / 500e-6)


@pytest.mark.parametrize("to", ["tiff", "csv", "netcdf", "psf"])
def test_interrupted_export_leaves_no_file(recording: Recording, tmp_path: Path, to: Format) -> None:
    def interrupt(_text: str, fraction: float) -> None:
        if fraction > 0.5:
            raise Interrupted("interrupted")

    with pytest.raises(Interrupted):
        exported(recording, to, tmp_path / "out", progress=interrupt)
    assert not list(tmp_path.iterdir())
