"""The Python interface: its examples run, and it keeps what its docstrings promise."""

from __future__ import annotations

import doctest
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.documents import python_blocks
from support.paths import DOCS, FOREIGN_FRAMES, ROOT
from support.patience import HANG_S

import svwfs
from app.bench.config import Bench
from app.evaluation.simulated_frames import SimulatedFrames
from app.files import read_image
from drivers.dcam.settings import DcamSettings
from drivers.serial_lights.settings import DC4100Settings
from reconstruction.arrays import Floats
from reconstruction.wavefront import rms


@pytest.fixture(scope="module")
def bench() -> Bench:
    return svwfs.load_bench("small_demo")


@pytest.fixture(scope="module")
def images(bench: Bench) -> SimulatedFrames:
    return svwfs.simulate(bench, frames=2)


def error_rad(views: Floats, truth: Floats) -> float:
    return float(rms(views - truth).mean())


def test_examples_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    result = doctest.testmod(svwfs)
    assert result.attempted > 40
    assert result.failed == 0


DOCUMENTS = [DOCS / "python.md", DOCS / "paper.md", ROOT / "README.md"]


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_documented_python_runs(document: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    program = python_blocks(document)
    assert "svwfs." in program
    exec(compile(program, document.name, "exec"), {})  # noqa: S102 - our own document


def test_import_loads_no_library() -> None:
    program = "import sys, svwfs; sys.exit(any(name in sys.modules for name in ('numpy', 'app', 'reconstruction')))"
    finished = subprocess.run([sys.executable, "-c", program], timeout=HANG_S, check=False)  # noqa: S603 - our own
    assert finished.returncode == 0


@pytest.mark.parametrize("name", svwfs.__all__)
def test_every_name_exists_and_is_documented(name: str) -> None:
    assert getattr(svwfs, name).__doc__
    assert name in dir(svwfs)


def test_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'wavefront'"):
        svwfs.wavefront  # noqa: B018 - the access is the test


def test_refinement_reduces_the_error(bench: Bench, images: SimulatedFrames) -> None:
    reconstruct = svwfs.reconstructor(bench, images.reference, dark=images.dark)
    once = reconstruct(images.frames[1])
    refined = svwfs.refine(reconstruct, images.frames[1])
    assert error_rad(refined.views, images.truth) < 0.7 * error_rad(once.views, images.truth) < 0.1


def test_foreign_frames_have_the_right_signs_and_axes() -> None:
    """The frames and their truth come from another simulator."""
    bench = svwfs.load_bench(FOREIGN_FRAMES / "bench.toml", "registration.warp=quadratic")
    reference, frame = (read_image(FOREIGN_FRAMES / f"square_{name}.tif") for name in ("reference", "frame"))
    wavefront = svwfs.reconstructor(bench, reference)(frame)
    assert error_rad(wavefront.views, np.load(FOREIGN_FRAMES / "truth.npz")["wavefront_rad"]) < 0.09


def test_frames_of_a_static_sample_differ_by_noise_alone(bench: Bench, images: SimulatedFrames) -> None:
    noise_free = svwfs.simulate(bench, frames=2, noise_free=True)
    assert np.array_equal(noise_free.frames[0], noise_free.frames[1])
    assert not np.array_equal(images.frames[0], images.frames[1])
    assert noise_free.dark.max() == 0
    settings = bench.camera_model
    expected = noise_free.frames[0] * settings.quantum_efficiency * settings.em_gain / settings.electrons_per_count
    mean = images.frames.mean(axis=0) - images.dark
    assert mean.sum() == pytest.approx(expected.sum(), rel=0.01)


def test_moving_sample_has_a_truth_for_every_frame(bench: Bench) -> None:
    moving = svwfs.load_bench("small_demo", "simulation.screen.drift_x_m_per_s=1e-3", "simulation.drifting_states=3")
    images = svwfs.simulate(moving, frames=3)
    assert images.truth.shape == (3, 3, 3, 7, 7)
    reconstruct = svwfs.reconstructor(bench, images.reference, dark=images.dark)
    errors = [[error_rad(reconstruct(frame).views, truth) for truth in images.truth] for frame in images.frames]
    assert np.argmin(errors, axis=1).tolist() == [0, 1, 2]
    with pytest.raises(svwfs.InputError, match=r"4 frames cannot be simulated: 1 \.\.\. 3 are possible"):
        svwfs.simulate(moving, frames=4)


def test_psf_is_the_strehl_ratio_at_angle_zero(bench: Bench, images: SimulatedFrames) -> None:
    wavefront = svwfs.reconstructor(bench, images.reference, dark=images.dark)(images.frames[0])
    image = svwfs.psf(wavefront, x_m=0.5e-3, y_m=-0.5e-3)
    strehl = svwfs.to_dataset(wavefront)["strehl"].isel(view_row=0, view_column=2)
    assert image.sel(angle_x=0, angle_y=0).item() == pytest.approx(strehl.item(), rel=1e-4)
    with pytest.raises(ValueError, match="outside the field"):
        svwfs.psf(wavefront, x_m=1e-3, y_m=0.0)


def test_live_bench_records_and_reports_what_it_used(bench: Bench, tmp_path: Path) -> None:
    with svwfs.live(bench, average=3) as live:
        measurement = next(iter(live))
        assert measurement.wavefront is not None
        assert live.bench.lattice is not None
        assert live.warning == ""
        live.take_dark(2)
        live.take_reference(2)
        folder = live.record(tmp_path / "run", frames=4)
        with pytest.raises(svwfs.InputError, match="holds a recording already"):
            live.record(folder, frames=1)
    assert list(live) == []
    recording = svwfs.open_recording(folder)
    assert len(recording) == 4
    frames = recording.frames
    assert frames.sizes == {"frame": 4, "row": 240, "column": 256}
    assert frames["frame_index"].values.tolist() == sorted(frames["frame_index"].values.tolist())
    assert np.array_equal(frames[1:3, 5, ::-7].values, frames.values[1:3, 5, ::-7])
    assert frames[2:2].values.shape == (0, 240, 256)
    assert recording.results()["wavefront"].sizes["frame"] == 4


def test_live_bench_closes_the_devices_after_an_error(bench: Bench) -> None:
    live = svwfs.live(bench, average=2)
    with pytest.raises(ZeroDivisionError), live:
        1 / 0  # noqa: B018 - any error
    assert not live._acquisition.is_alive


def test_missing_device_is_reported_on_entering(bench: Bench) -> None:
    absent = replace(bench, camera=DcamSettings(), light=DC4100Settings(port="none"))
    with pytest.raises(svwfs.DeviceError), svwfs.live(absent):
        pass


@pytest.mark.parametrize("path", ["missing.nc", "empty.nc"])
def test_open_result_names_an_unusable_file(path: str, tmp_path: Path) -> None:
    (tmp_path / "empty.nc").touch()
    with pytest.raises(svwfs.InputError, match=path):
        svwfs.open_result(tmp_path / path)
