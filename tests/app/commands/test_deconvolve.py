"""`svwfs deconvolve`: sources of wavefronts, the file it writes, refusals, and interruption."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import tifffile
import xarray as xr
from support.command_line import run
from support.recordings import record

import svwfs
from app.bench.config import load_bench
from app.errors import InputError, Interrupted
from app.recording.reader import Recording
from app.recording.reprocess import reprocess
from app.results.dataset import result_dataset, results_in_pieces
from app.results.deconvolution import write_corrected
from app.results.result_file import open_results, write_results
from app.results.sources import mean_wavefront, read_bench_of

SCALE = ("--scale", "10e-6")


@pytest.fixture(scope="module")
def recording(small_toml: Path, tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return record(small_toml, tmp_path_factory.mktemp("recording") / "run", frames=3)


@pytest.fixture(scope="module")
def result(recording: Recording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results of the recording, and beside them `single.nc`, of one frame and view."""
    path = tmp_path_factory.mktemp("result") / "result.nc"
    (piece,) = results_in_pieces((made, {}) for made in reprocess(recording))
    write_results(path, piece, bench=recording.bench, inputs={})
    with open_results(path) as results:
        one_view = results.isel(frame=0, view_row=[1], view_column=[1]).drop_vars("coefficients").load()
    one_view.encoding.clear()
    one_view.to_netcdf(path.with_name("single.nc"), engine="h5netcdf")
    return path


def test_second_page_is_white_where_the_image_is_corrected(tmp_path: Path) -> None:
    inside = np.array([[True, True, False], [False, True, False]])
    image, attributes = np.arange(6, dtype=np.float32).reshape(2, 3), {"iterations": 3, "chi_square": 1.1}
    pixels = ("row", "column")
    found = xr.Dataset({"image": (pixels, image), "inside": (pixels, inside)}, attrs=attributes)
    write_corrected(tmp_path / "corrected.tif", found, {})
    np.testing.assert_array_equal(tifffile.imread(tmp_path / "corrected.tif", key=0), image)
    np.testing.assert_array_equal(tifffile.imread(tmp_path / "corrected.tif", key=1), [[255, 255, 0], [0, 255, 0]])


@pytest.fixture(scope="module")
def zonal(small_toml: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recording") / "zonal"
    record(small_toml, folder, "reconstruction.method=zonal", frames=1)
    return folder


@pytest.fixture
def image(tmp_path: Path) -> Path:
    y, x = np.indices((150, 160))
    light = 800 * np.exp(-((x - 80) ** 2 + (y - 75) ** 2) / 200) + 50
    path = tmp_path / "image.tif"
    tifffile.imwrite(path, np.random.default_rng(2).poisson(light).astype(np.uint16))
    return path


@pytest.mark.slow
@pytest.mark.long
def test_writes_image_and_mark(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], image: Path, result: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out.tif"
    assert run(monkeypatch, "deconvolve", image, "--with", result, *SCALE, "--out", out, "--iterations", "4") == 0
    assert "iterations, chi-square" in capsys.readouterr().out
    with tifffile.TiffFile(out) as file:
        corrected, mark = (page.asarray() for page in file.pages)
        about = json.loads(file.pages.first.description)
    assert corrected.dtype == np.float32
    assert mark.dtype == np.uint8
    assert about["method"] == "richardson-lucy"
    before = tifffile.imread(image)
    inside = np.zeros((150, 160), np.bool_)
    inside[15:135, 20:140] = True  # 1.2 mm of 10 um pixels in the middle
    np.testing.assert_array_equal(mark, np.where(inside, 255, 0))
    np.testing.assert_array_equal(corrected[~inside], before[~inside])
    assert (corrected[inside] != before[inside]).mean() > 0.9


@pytest.mark.slow
@pytest.mark.long
def test_recording_and_its_results_have_the_same_wavefront(recording: Recording, result: Path) -> None:
    frames = [made.wavefront for made in reprocess(recording)]
    position = (0.31e-3, -0.47e-3)
    expected = np.mean([wavefront.at(*position) for wavefront in frames if wavefront], axis=0)
    for source in (recording.folder, result):
        phase_at = mean_wavefront(source, read_bench_of(source), None, lambda *_: None)
        np.testing.assert_allclose(phase_at(*position), expected, atol=1e-9)
        last = mean_wavefront(source, read_bench_of(source), "2:3", lambda *_: None)
        assert frames[2] is not None
        np.testing.assert_allclose(last(*position), frames[2].at(*position), atol=1e-9)


@pytest.mark.slow
@pytest.mark.long
def test_zonal_results_are_interpolated_between_views(zonal: Path) -> None:
    (made,) = reprocess(Recording(zonal))
    assert made.wavefront is not None
    phase_at = mean_wavefront(zonal, read_bench_of(zonal), None, lambda *_: None)
    at_view = made.wavefront.at(0.5e-3, -0.5e-3)
    np.testing.assert_allclose(phase_at(0.5e-3, -0.5e-3), at_view, atol=1e-9)
    between = made.wavefront.at(0.2e-3, -0.3e-3)  # the quartic warp is no parabola over three views
    assert np.nanstd(phase_at(0.2e-3, -0.3e-3) - between) < 0.1 * np.nanstd(between)


@pytest.mark.slow
def test_python_corrects_as_the_command_does(
    monkeypatch: pytest.MonkeyPatch, image: Path, result: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out.tif"
    assert run(monkeypatch, "deconvolve", image, "--with", result, *SCALE, "--out", out, "--iterations", "3") == 0
    bench = read_bench_of(result, ("imaging.pixel_m=10e-6",))
    ours = svwfs.deconvolve(tifffile.imread(image), result, bench, iterations=3)
    np.testing.assert_array_equal(ours.values, tifffile.imread(out))
    assert ours.inside.sum() == 120 * 120
    with pytest.raises(InputError, match="a wavefront is needed"):
        svwfs.deconvolve(tifffile.imread(image), 3.0, bench)  # type: ignore[arg-type] # the point of the test


@pytest.mark.slow
def test_geometry_comes_from_toml_and_options(
    monkeypatch: pytest.MonkeyPatch, image: Path, result: Path, tmp_path: Path
) -> None:
    toml, out = tmp_path / "image.toml", tmp_path / "out.tif"
    toml.write_text("[imaging]\npixel_m = 20e-6\ncenter_x_px = 60\nis_mirrored = false\n")
    arguments = ("deconvolve", image, "--with", result, "--imaging", toml, "--iterations", "1", "--out", out)
    assert run(monkeypatch, *arguments, "--set", "imaging.center_y_px=90.0", "--set", "imaging.center_x_px=70.0") == 0
    mark = tifffile.imread(out, key=1)
    rows, columns = (np.flatnonzero(mark.any(axis=axis)) for axis in (1, 0))
    assert (rows[0], rows[-1], columns[0], columns[-1]) == (60, 120, 40, 100)


def refusals(tmp_path: Path, result: Path) -> list[tuple[list[str | Path], str]]:
    single = result.with_name("single.nc")
    rgb = tmp_path / "rgb.tif"
    tifffile.imwrite(rgb, np.full((20, 30, 3), (0, 9, 0), np.uint8), photometric="rgb")
    (no_size := tmp_path / "no_size.toml").write_text("[imaging]\npixel_m = 0.0\n")
    good: str | Path = tmp_path / "image.tif"
    with_result: list[str | Path] = ["--with", result]
    out: list[str | Path] = ["--out", tmp_path / "new.tif"]
    return [
        ([good, *with_result, *out], "its scale is unknown: give --scale"),
        ([good, *with_result, "--scale", "0", *out], "svwfs: --scale (imaging.pixel_m) must be 1e-10 ..."),
        ([good, *with_result, "--imaging", no_size, *out], "no_size.toml: imaging.pixel_m must be"),
        ([rgb, *with_result, *SCALE, *out], "is a colour image"),
        ([good, *with_result, *SCALE, "--set", "imaging.center_x_px=9000.0", *out], "field covers 0 x"),
        ([good, "--with", single, *SCALE, *out], "neither coefficients nor several views"),
        ([good, *with_result, *SCALE, "--set", "imaging.pupil=3", *out], "imaging.pupil is an unknown key"),
        ([good, *with_result, *SCALE, "--set", "imaging.pupil_diameter_m=1.0", *out], "wider than the lattice"),
        ([good, "--with", good, *SCALE, *out], "not a NetCDF-4 file"),
        ([good, *with_result, *SCALE, "--frames", "7:9", *out], "selects no frame"),
        ([good, *with_result, "--imaging", result, *out], "not a text file"),
    ]


@pytest.mark.slow
def test_bad_input_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], image: Path, result: Path, tmp_path: Path
) -> None:
    assert image.exists()
    for arguments, sentence in refusals(tmp_path, result):
        assert run(monkeypatch, "deconvolve", *arguments) == 2
        said = capsys.readouterr().err
        assert said.count("\n") == 1
        assert sentence in said
        assert not (tmp_path / "new.tif").exists()


@pytest.mark.slow
def test_interruption_leaves_no_file(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], image: Path, result: Path, tmp_path: Path
) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise Interrupted("interrupted")

    monkeypatch.setattr("app.results.deconvolution.corrected_image", interrupted)
    before = set(tmp_path.iterdir())
    out = tmp_path / "out.tif"
    assert run(monkeypatch, "deconvolve", image, "--with", result, *SCALE, "--out", out) == 130
    assert "out.tif is not written" in capsys.readouterr().err
    assert set(tmp_path.iterdir()) == before


@pytest.mark.slow
def test_result_keeps_the_section(tmp_path: Path) -> None:
    """The bench of a result brings the geometry of its image along."""
    bench = load_bench("small_demo", ("imaging.pixel_m=3e-6", "imaging.numerical_aperture=0.005"))
    images = svwfs.simulate(bench)
    wavefront = svwfs.reconstructor(bench, images.reference, dark=images.dark)(images.frames[0])
    write_results(tmp_path / "r.nc", result_dataset(wavefront), bench=bench, inputs={})
    assert read_bench_of(tmp_path / "r.nc").imaging == bench.imaging
