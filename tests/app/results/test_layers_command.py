"""`svwfs layers` and `svwfs corrector` on a recording and its results, and the files of a corrector's command."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import xarray as xr
from support.command_line import run
from support.recordings import record

from app.bench.config import load_bench
from app.errors import InputError
from app.evaluation.frames import simulate
from app.measurement.offline_reconstructor import OfflineReconstructor
from app.results.corrector import compare_correctors, corrector_sentence, draw_corrector, write_phase
from app.results.layers import (
    Origin,
    centred,
    distance_m,
    distances_and_sigma_m,
    draw_layers,
    layer_maps,
    layer_sentences,
    layers_dataset,
    ratio_at,
)
from reconstruction.arrays import Floats
from reconstruction.layers.corrector import Corrector
from reconstruction.layers.layer_search import search_layers
from reconstruction.layers.layer_solver import Layer
from simulated_devices.sample import make_sample

DISTANCE_M = 0.195  # of the screen in small_demo


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("layers") / "run"
    with pytest.MonkeyPatch.context() as monkeypatch:
        assert run(monkeypatch, "measure", "--bench", "small_demo", "--frames", "1", "--out", folder) == 0
    return folder


@pytest.fixture(scope="module")
def small_recording(small_toml: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(small_toml, tmp_path_factory.mktemp("small") / "run", frames=1).folder


@pytest.mark.slow
def test_command_loads_only_what_it_needs(recording: Path, tmp_path: Path) -> None:
    rooms = ("app", "drivers", "reconstruction", "simulated_devices")
    count = f"len([name for name in sys.modules if name.split('.')[0] in {rooms}])"
    program = f"import atexit, sys; from app.cli import main; atexit.register(lambda: print({count})); main()"
    layers = ("layers", recording / "results.nc", "--out", tmp_path / "l.nc")
    for most, arguments in ((100, layers), (20, ("recover", "--help"))):
        command = [sys.executable, "-c", program, *map(str, arguments)]
        finished = subprocess.run(command, check=True, capture_output=True, text=True)  # noqa: S603 - our own program
        assert int(finished.stdout.splitlines()[-1]) <= most, arguments


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize("kind", ["recording", "result"])
def test_layer_is_found(recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str) -> None:
    source = recording if kind == "recording" else recording / "results.nc"
    out, plot = tmp_path / "layers.nc", tmp_path / "layers.png"
    assert run(monkeypatch, "layers", source, "--out", out, "--plot", plot) == 0
    assert plot.stat().st_size > 10_000
    with xr.open_dataset(out, engine="h5netcdf") as found:
        assert found["distance_m"].values == pytest.approx([DISTANCE_M], rel=0.02)
        assert 1e-4 < found["distance_sigma_m"].item() < 0.01
        assert (found.attrs["verdict"], found.attrs["doubt"]) == ("one layer", "")
        assert layer_sentences(found)[-1] == "verdict: one layer"
        tiny = layer_sentences(found.assign(model_chi_square=0 * found["model_chi_square"] + 0.001))
        assert "reduced chi-square below 0.01" in tiny[-2]
        for factor in (0.5, 2.0):
            misfits = found["model_misfit"].where(found["model"] == "any wavefront", factor * found["model_misfit"][-1])
            line = layer_sentences(found.assign(model_misfit=misfits))[-2]
            assert line.endswith("; layers leave less, because this fit is smoothed") == (factor < 1)
        doubtful = layer_sentences(found.assign_attrs(doubt="nothing fits"))
        assert doubtful[-1] == "verdict: one layer; but nothing fits"
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


@pytest.mark.slow
@pytest.mark.long
def test_distances_from_the_mask_and_given_ones(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "layers.nc"
    assert run(monkeypatch, "layers", recording, "--from", "mask", "--distance", "0.1", "--out", out) == 0
    assert "frame 0: layer 100.0 mm from the mask" in capsys.readouterr().out
    with xr.open_dataset(out, engine="h5netcdf") as found:
        assert np.isnan(found["distance_sigma_m"].item())
        # s = u d / f1 + x (1 - d / f1)
        assert found.x.max().item() == pytest.approx(0.5 * 1.75e-3 + 0.5 * 0.6e-3)
        figure = draw_layers(found)
    assert len(figure.axes) == 5


def test_distances_and_ratios_belong_together() -> None:
    bench = load_bench("small_demo")  # f1 = 0.2 m
    assert ratio_at(0.1, "lenslets", bench) == pytest.approx(-0.5)  # in front of the lenslets
    assert ratio_at(-0.1, "lenslets", bench) == pytest.approx(0.5)
    assert ratio_at(0.02, "mask", bench) == pytest.approx(-9.0)
    for origin in ("lenslets", "mask"):
        assert distance_m(ratio_at(0.13, origin, bench), origin, bench) == pytest.approx(0.13)
    assert distance_m(0.0, "mask", bench) == pytest.approx(0.2)
    assert np.isnan(distance_m(0.5, "mask", bench))  # behind the lenslets
    for distance, origin in ((-10, "lenslets"), (np.nan, "lenslets"), (0.0, "mask"), (0.3, "mask")):
        with pytest.raises(InputError, match="lies outside the search range"):
            ratio_at(distance, origin, bench)  # type: ignore[arg-type] # a name


@pytest.mark.parametrize("origin", ["lenslets", "mask"])
def test_error_bar_of_a_distance_follows_that_of_the_ratio(origin: Origin) -> None:
    bench, step = load_bench("small_demo"), 1e-6
    layer = Layer(-3.0, 0.01, np.ones(2), np.zeros(1), np.zeros((1, 1)), 1)
    (distance,), (sigma,) = distances_and_sigma_m((layer,), origin, bench)
    low, high = (float(distance_m(-3.0 + side * step, origin, bench)) for side in (-1, 1))
    assert low == pytest.approx(distance, rel=1e-5)
    assert sigma == pytest.approx(0.01 * abs(high - low) / (2 * step), rel=1e-5)


@pytest.mark.slow
def test_layer_behind_the_lenslets_has_no_distance_from_the_mask() -> None:
    bench = load_bench("small_demo", ("simulation.screen.distance_m=-0.1",))
    images = simulate(bench)
    reconstruct = OfflineReconstructor(bench, images.reference, dark=images.dark)
    wavefront = reconstruct(images.frames[0])
    found = layers_dataset(search_layers(reconstruct.layers(wavefront)), bench, "mask")
    assert found.attrs["distances_from"] == "lenslets"
    assert found["distance_m"].item() == pytest.approx(-0.1, rel=0.1)
    assert layer_sentences(found)[0].endswith(" mm behind the lenslets")
    low_mm, high_mm = draw_layers(found).axes[0].get_xlim()
    assert (low_mm, high_mm) == pytest.approx((-300, 150))
    corrector, _ = compare_correctors(wavefront.at, bench, Corrector("zernike", 45), at_m=None, origin="mask")
    assert corrector["corrector_distance_m"].item() == pytest.approx(-0.1, rel=0.2)
    assert " mm behind the lenslets, " in corrector_sentence(corrector)


@pytest.mark.slow
@pytest.mark.long
def test_best_corrector_lies_in_the_screen(recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out, plot, command = tmp_path / "c.nc", tmp_path / "c.png", tmp_path / "command.npy"
    files = ("--out", out, "--plot", plot, "--command", command, "--pixels", "65")
    assert run(monkeypatch, "corrector", recording, "--modes", "legendre", *files) == 0
    assert plot.stat().st_size > 10_000
    with xr.open_dataset(out, engine="h5netcdf") as found:
        chosen = found["residual"].sel(distance=found["corrector_distance_m"].item())
        assert chosen.item() == found["corrector_residual"].item() == found["residual"].min().item()
        assert len(np.unique(found["distance"])) == found["distance"].size
        curve, *lines = draw_corrector(found).axes[0].lines
        assert {tuple(np.unique(line.get_ydata())) for line in lines} == {
            (found["corrector_residual"].item(),),
            (found["uncorrected"].item(),),
        }
        assert np.isin(lines[0].get_xydata(), curve.get_xydata()).all()
        assert found["corrector_distance_m"].item() == pytest.approx(0.195, rel=0.05)
        assert found["corrector_residual"].item() < 0.07 * found["residual"].sel(distance=0)
        assert {np.sign(found["distance"].values[at]) for at in (0, -1)} == {-1, 1}
        assert found["field_residual"].size == 49
        distance_m = found["corrector_distance_m"].item()
    bench = load_bench("small_demo")
    screen = make_sample(bench.simulation, bench.sensor, bench.field).screen
    phase = np.load(command)
    half_m = 1.75e-3 + distance_m / 0.2 * 0.6e-3
    at_m = np.linspace(-half_m, half_m, 65)
    inner = slice(8, -8)
    sum_rad = (phase + screen.at(at_m, at_m[:, None]))[inner, inner]  # the command is the opposite of the screen
    assert np.std(sum_rad) < 0.1 * np.std(phase[inner, inner])


@pytest.mark.slow
def test_residual_at_the_pupil_is_the_change_over_the_field(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At the pupil all positions get the same phase: what remains is the deviation from the mean wavefront."""
    out = tmp_path / "c.nc"
    assert run(monkeypatch, "corrector", recording, "--distance", "0", "--count", "36", "--out", out) == 0
    bench = load_bench("small_demo")
    sensor, screen = bench.sensor, make_sample(bench.simulation, bench.sensor, bench.field).screen
    along_m = np.linspace(-1, 1, 7) * bench.field.half_width_m
    x_m = sensor.pupil_x_m - 0.975 * along_m[:, None]  # (field, lenslet)
    true = screen.at(x_m[None, :, None, :], x_m[:, None, :, None]).reshape(49, *(2 * [sensor.lenslets[0]]))
    true -= true.mean(axis=(1, 2), keepdims=True)
    expected = np.sqrt(np.mean((true - true.mean(axis=0)) ** 2))
    with xr.open_dataset(out, engine="h5netcdf") as found:
        assert found["corrector_residual"].item() == pytest.approx(expected, rel=0.1)


def test_maps_near_the_mask_are_smaller_along_both_axes() -> None:
    """Rays between lenslets and mask meet: half way, a layer at the ratio -1 has half the size of the pupil."""
    layer = Layer(-1.0, 0.0, np.array([2e-3, 1e-3]), np.zeros(1), np.zeros((1, 1)), 1)
    x_m, y_m, maps = layer_maps((layer,), "mask", lambda _, x_m, y_m: x_m + 10 * y_m, 3)
    np.testing.assert_allclose(x_m, [-1e-3, 0, 1e-3])
    np.testing.assert_allclose(y_m, [-0.5e-3, 0, 0.5e-3])
    np.testing.assert_allclose(maps[0, :, 2], [-8e-3, 2e-3, 12e-3])  # at +2 mm and -1, 0, +1 mm of the pupil


def test_corrector_at_the_pupil_is_that_at_no_distance() -> None:
    found = xr.Dataset(
        {
            "residual": ("distance", [0.5, 0.3, 0.1]),
            "corrector_distance_m": ((), 0.2),
            "corrector_residual": ((), 0.1),
            "uncorrected": ((), 0.9),
            "field_strehl": ("position", [0.7, 0.9]),
        },
        {"distance": [-0.3, 0.01, 0.2]},
        {"distances_from": "lenslets"},
    )
    pupil = "one corrector at the pupil leaves 0.3 of 0.9 rad RMS"
    sentence = f"{pupil}; 200.0 mm in front of the lenslets, 0.1 rad (Strehl 0.80)"
    assert corrector_sentence(found) == sentence


def test_maps_use_their_colours_although_a_corner_is_far_off() -> None:
    phase = np.append(np.linspace(2, 6, 999), np.nan).reshape(20, 50)
    phase[0, 0] = -40
    shown, limit = centred(phase)
    assert limit == pytest.approx(1.96, abs=0.01)  # from 1 to 99 % of 2 ... 6
    assert shown[0, 1:].tolist() == pytest.approx((phase[0, 1:] - 4).tolist(), abs=0.01)
    assert np.isnan(shown[-1, -1])


def test_command_files_hold_the_phase(tmp_path: Path) -> None:
    phase = np.add.outer(np.linspace(-3, 9, 12), np.linspace(0, 5, 20))
    for suffix in ("npy", "fits", "png"):
        write_phase(tmp_path / f"c.{suffix}", phase)
    np.testing.assert_allclose(np.load(tmp_path / "c.npy"), phase, rtol=1e-6)
    grey = np.asarray(cv2.imread(str(tmp_path / "c.png"), cv2.IMREAD_UNCHANGED))
    back = grey.astype(float) / 256 * 2 * np.pi
    np.testing.assert_allclose(np.exp(1j * back), np.exp(1j * phase), atol=2 * np.pi / 256)
    content = (tmp_path / "c.fits").read_bytes()
    assert len(content) == 2 * 2880
    cards = [content[at : at + 80].decode("ascii") for at in range(0, 2880, 80)]
    assert cards[0][:30] == "SIMPLE  =                    T"
    assert [card[:8].strip() for card in cards[:7]] == ["SIMPLE", "BITPIX", "NAXIS", "NAXIS1", "NAXIS2", "BUNIT", "END"]
    assert int(cards[3][10:]) == 20
    np.testing.assert_allclose(np.frombuffer(content[2880 : 2880 + 960], ">f4").reshape(12, 20), phase, rtol=1e-6)


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["layers", "--distance", "-9"], "lies outside the search range"),
        (["layers", "--distance", "0.1", "--distance", "0.1"], "two different distances"),
        (["layers", "--distance", "1", "--distance", "2", "--distance", "3"], "two different distances"),
        (["layers", "--frame", "7"], "there is no frame 7; frames are counted from 0, their number is 1"),
        (["layers", "--distance", "1e9"], "outside the search range, -4.8 ... 4.8 m from the lenslets"),
        (["layers", "--layers", "2", "--distance", "0.1"], "the two different distances of two layers, or none"),
        (["corrector", "--out", "c.png"], "c.png: .png does not fit the format"),
        (["corrector", "--modes", "actuators", "--count", "20"], "square"),
        (["corrector", "--count", "900"], "2 ... 500"),
        (["corrector", "--distance", "0.3", "--from", "mask"], "lies outside the search range"),
        (["corrector", "--command", "c.bmp"], "ends in one of"),
        (["corrector", "--frames", "5:9"], "frame"),
    ],
)
def test_bad_input_is_one_line(
    small_recording: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    words: list[str],
    sentence: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    command, *options = words
    out = () if "--out" in options else ("--out", "out.nc")
    assert run(monkeypatch, command, small_recording, *out, *options) == 2
    assert sentence in capsys.readouterr().err.strip().splitlines()[-1]
    assert not list(tmp_path.iterdir())


def of_the_future(found: xr.Dataset) -> xr.Dataset:
    return found.assign_attrs(software="svwfs 99.1", bench=found.attrs["bench"] + "\n[future]\nx = 1\n")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "change", "sentence"),
    [
        ("layers", lambda found: found.drop_vars("valid"), "is damaged: it lacks valid"),
        ("layers", lambda found: found.assign(displacement_sigma=0 * found["displacement_sigma"]), "above 0 px"),
        ("layers", lambda found: found.assign(coefficients=found["coefficients"] * np.nan), "a coefficient of nan rad"),
        ("corrector", lambda found: found.assign(coefficients=found["coefficients"] * 1e9), "which no wavefront has"),
        ("layers", lambda found: found.drop_vars("displacement"), "holds wavefronts that were not measured, such as"),
        ("field", lambda found: found.drop_vars("displacement"), "give a recording, or a file that svwfs reconstruct"),
        ("corrector", of_the_future, "damaged.nc: a newer svwfs, 99.1, wrote it: update svwfs to read it"),
        ("layers", lambda found: found.drop_vars("coefficients"), "reconstruct with reconstruction.method=modal"),
    ],
)
def test_damaged_results_are_refused(
    recording: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    *,
    command: str,
    change: Callable[[xr.Dataset], xr.Dataset],
    sentence: str,
) -> None:
    with xr.open_dataset(recording / "results.nc", engine="h5netcdf") as results:
        change(results).to_netcdf(tmp_path / "damaged.nc", engine="h5netcdf")
    assert run(monkeypatch, command, tmp_path / "damaged.nc", "--out", tmp_path / "out.nc") == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert sentence in line
    assert not (tmp_path / "out.nc").exists()


def test_corrector_needs_a_wavefront_that_changes_over_the_field() -> None:
    bench = load_bench("small_demo")
    same = np.add.outer(np.arange(bench.sensor.lenslets[0]), np.arange(bench.sensor.lenslets[1])) ** 2.0
    with pytest.raises(ValueError, match="the same at every field position"):
        compare_correctors(lambda _x, _y: same, bench, Corrector("zernike", 10), at_m=None, origin="lenslets")


def test_uncorrected_is_the_rms_over_field_and_pupil() -> None:
    bench = load_bench("small_demo")
    pupil = np.add.outer(np.arange(bench.sensor.lenslets[0]), np.arange(bench.sensor.lenslets[1])) / 10.0

    def wavefront(x_m: float, y_m: float) -> Floats:
        return pupil * (x_m - 2 * y_m) / bench.field.half_width_m

    found, _ = compare_correctors(wavefront, bench, Corrector("zernike", 3), at_m=0.0, origin="lenslets")
    growth = (found["field_x"] - 2 * found["field_y"]).values / bench.field.half_width_m
    assert found["uncorrected"].item() == pytest.approx(np.std(pupil) * np.sqrt(np.mean(growth**2)))
