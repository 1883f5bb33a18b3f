"""A hexagonal bench from calibration to results, and its residual beside that of a square lattice."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile
import xarray as xr

from app.bench.config import Bench, load_bench
from app.cli import main
from app.errors import InputError
from app.evaluation.frames import simulate
from app.evaluation.paper import compare
from app.measurement.calibration import Calibration
from reconstruction.geometry import nominal_lattice
from reconstruction.wavefront import rms

HEXAGONAL = (
    "lattice.arrangement=hexagonal",
    "sensor.lenslet_rows=7",
    f"sensor.lenslet_pitch_m={500e-6 * math.sqrt(2 / math.sqrt(3))}",  # lenslets of the same area
    "camera.rows=250",
    "camera.columns=280",
)


def run(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> None:
    monkeypatch.setattr("sys.argv", ["svwfs", *map(str, arguments)])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 0


@pytest.mark.slow
@pytest.mark.long
def test_calibrated_bench_reconstructs_frames_to_results(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    bench = load_bench("small_demo", HEXAGONAL)
    made = simulate(bench)
    for name, image in (("reference", made.reference), ("dark", made.dark), ("frame", made.frames[0])):
        tifffile.imwrite(tmp_path / f"{name}.tif", np.asarray(image, np.float32))
    settings = [word for setting in HEXAGONAL for word in ("--set", setting)]
    found, results, dark = tmp_path / "found.toml", tmp_path / "r.nc", tmp_path / "dark.tif"
    plots = tmp_path / "lattice.png", tmp_path / "views.png"
    run(
        monkeypatch,
        *("calibrate", tmp_path / "reference.tif", "--dark", dark, "--bench", "small_demo", *settings),
        *("--out", found, "--plot", plots[0]),
    )
    lattice = load_bench(found).lattice
    assert lattice is not None
    assert lattice.arrangement == "hexagonal"
    expected = nominal_lattice(bench.sensor, *made.reference.shape).lenslet_centers_px(7, 7)
    np.testing.assert_allclose(lattice.lenslet_centers_px(7, 7), expected, atol=0.1)
    run(
        monkeypatch,
        *("reconstruct", tmp_path / "frame.tif", "--reference", tmp_path / "reference.tif", "--dark", dark),
        *("--bench", found, "--out", results, "--plot", plots[1]),
    )
    assert all(plot.stat().st_size > 10_000 for plot in plots)
    with xr.open_dataset(results) as read:
        assert read["pupil_x"].dims == ("lenslet_row", "lenslet_column")
        np.testing.assert_allclose(read["pupil_x"][1] - read["pupil_x"][0], bench.sensor.lenslet_pitch_m / 2)
        error = rms(read["wavefront"].values - made.truth)
        assert error.max() < 0.02 * rms(made.truth).min()


def relative_error(bench: Bench, method: str) -> float:
    """Mean residual of the views over the mean wavefront, with the noise of the simulated camera."""
    settings = replace(bench.reconstruction, method=method)  # type: ignore[arg-type] # one of two words
    made = simulate(bench)
    lattice = nominal_lattice(bench.sensor, *made.reference.shape)
    bench = replace(bench, reconstruction=settings)
    prepared = Calibration.of_images(bench, made.reference, dark=made.dark, lattice=lattice).reconstructor()
    views = prepared(made.frames[0]).views
    assert np.isfinite(views).all()
    return float(np.mean(rms(views - made.truth)) / np.mean(rms(made.truth)))


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize(("method", "mask"), [("zonal", "checkerboard"), ("modal", "square")])
def test_residual_is_at_most_that_of_as_many_square_lenslets(method: str, mask: str) -> None:
    """The issue allows 1.2 times; the paper's bench reaches 0.85 and 0.93 (evidence/accuracy.md)."""

    def mean_error(*settings: str) -> float:
        of_mask = f"simulation.source.mask='{mask}'"
        benches = [load_bench("small_demo", (f"simulation.seed={seed}", of_mask, *settings)) for seed in (1, 2)]
        return float(np.mean([relative_error(bench, method) for bench in benches]))

    square, hexagonal = mean_error(), mean_error(*HEXAGONAL)
    assert hexagonal < 1.2 * square
    assert hexagonal < 0.06


@pytest.mark.slow
@pytest.mark.long
def test_layer_is_found_where_the_screen_is() -> None:
    bench = load_bench("small_demo", HEXAGONAL)
    made = simulate(bench)
    lattice = nominal_lattice(bench.sensor, *made.reference.shape)
    prepared = Calibration.of_images(bench, made.reference, dark=made.dark, lattice=lattice).reconstructor()
    wavefront = prepared(made.frames[0])
    equations = prepared.layers(wavefront.displacement)
    fit, away = equations.fit(-0.195 / 0.2), equations.fit(0.195 / 0.2)
    assert fit.quality.misfit < 0.2 * away.quality.misfit
    phase = fit.wavefront(bench.sensor, 0.5e-3, -0.5e-3)
    truth = made.truth[0, 2]
    assert rms(phase - truth) < 0.05 * rms(truth)


def test_table_of_a_hexagonal_bench_is_refused() -> None:
    bench = load_bench("small_demo", HEXAGONAL)
    with pytest.raises(InputError, match="made for square lattices"):
        compare("table1", bench, seeds=1, with_peers=False, progress=lambda *_: None)
