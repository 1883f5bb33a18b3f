"""The Python interface: its examples run, and it keeps what its docstrings promise."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from support.command_line import run
from support.paths import FOREIGN_FRAMES
from support.patience import HANG_S
from support.pictures import html_picture
from support.python_examples import run_examples

import svwfs
from app.bench.config import Bench
from app.evaluation.frames import SimulatedFrames
from app.images import read_image
from reconstruction.arrays import Floats
from reconstruction.wavefront import rms


@pytest.fixture(scope="module")
def bench() -> Bench:
    return svwfs.load_bench("small_demo")


@pytest.fixture(scope="module")
def images(bench: Bench) -> SimulatedFrames:
    return svwfs.simulate(bench, frames=2)


@pytest.fixture(scope="module")
def wavefront(bench: Bench, images: SimulatedFrames) -> svwfs.Wavefront:
    return svwfs.reconstructor(bench, images.reference, dark=images.dark)(images.frames[0])


def error_rad(views: Floats, truth: Floats) -> float:
    return float(rms(views - truth).mean())


@pytest.mark.slow
@pytest.mark.long
def test_examples_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    result = run_examples()
    assert result.attempted > 30
    assert result.failed == 0


def test_import_loads_no_library() -> None:
    packages = ("app.", "drivers.", "reconstruction.", "simulated_devices.")
    program = (
        f"import sys, svwfs; sys.exit(any(name == 'numpy' or name.startswith({packages}) for name in sys.modules))"
    )
    finished = subprocess.run([sys.executable, "-c", program], timeout=HANG_S, check=False)  # noqa: S603 - our own
    assert finished.returncode == 0


@pytest.mark.parametrize("name", svwfs.__all__)
def test_every_name_exists_and_is_documented(name: str) -> None:
    assert getattr(svwfs, name).__doc__
    assert name in dir(svwfs)


def test_images_may_be_reused_before_the_first_frame(
    bench: Bench, images: SimulatedFrames, wavefront: svwfs.Wavefront
) -> None:
    reference, dark = images.reference.copy(), images.dark.copy()
    reconstruct = svwfs.reconstructor(bench, reference, dark=dark)
    reference[:] = dark[:] = 0
    np.testing.assert_array_equal(reconstruct(images.frames[0]).views, wavefront.views)


def test_wavefront_cannot_be_changed_but_its_dataset_can(wavefront: svwfs.Wavefront) -> None:
    before = wavefront.views.copy(), wavefront.displacement.coefficients.copy()
    with pytest.raises(ValueError, match="read-only"):
        wavefront.views[:] = 0
    dataset = svwfs.to_dataset(wavefront)
    for name in ("wavefront", "displacement"):
        dataset[name] *= 2
    np.testing.assert_array_equal(wavefront.views, before[0])
    np.testing.assert_array_equal(wavefront.displacement.coefficients, before[1])


def test_arguments_that_do_not_fit_are_refused(
    tmp_path: Path, bench: Bench, images: SimulatedFrames, wavefront: svwfs.Wavefront
) -> None:
    reconstruct = svwfs.reconstructor(bench, images.reference)
    other = replace(bench, sensor=replace(bench.sensor, wavelength_m=5e-7))
    wrong: dict[str, Callable[[], object]] = {
        "degree must be a whole number": lambda: svwfs.field_coefficients(wavefront, degree=2.5),  # type: ignore[arg-type] # refused
        "a wavefront is needed": lambda: svwfs.find_layers(wavefront, reconstruct),  # type: ignore[arg-type] # refused
        "cannot have the name 5": lambda: svwfs.connect(5),  # type: ignore[arg-type] # refused
        "another sensor or field": lambda: svwfs.save_result(tmp_path / "out.nc", wavefront, other),
    }
    for sentence, call in wrong.items():
        with pytest.raises(svwfs.InputError, match=sentence):
            call()


@pytest.mark.slow
@pytest.mark.long
def test_refinement_reduces_the_error(bench: Bench) -> None:
    """Without noise: in it, one pass over the layer found is as good."""
    images = svwfs.simulate(bench, noise_free=True)
    reconstruct = svwfs.reconstructor(bench, images.reference, dark=images.dark)
    once = reconstruct(images.frames[0])
    refined = svwfs.refine(reconstruct, images.frames[0])
    assert error_rad(refined.views, images.truth) < error_rad(once.views, images.truth) < 0.02


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


@pytest.mark.slow
@pytest.mark.long
def test_moving_sample_has_a_truth_for_every_frame(bench: Bench) -> None:
    moving = svwfs.load_bench("small_demo", "simulation.screen.drift_x_m_per_s=1e-3", "simulation.drifting_states=3")
    images = svwfs.simulate(moving, frames=3)
    assert images.truth.shape == (3, 3, 3, 7, 7)
    reconstruct = svwfs.reconstructor(bench, images.reference, dark=images.dark)
    errors = [[error_rad(reconstruct(frame).views, truth) for truth in images.truth] for frame in images.frames]
    assert np.argmin(errors, axis=1).tolist() == [0, 1, 2]
    with pytest.raises(svwfs.InputError, match=r"4 frames cannot be simulated: 1 \.\.\. 3 are possible"):
        svwfs.simulate(moving, frames=4)


def test_psf_is_the_strehl_ratio_at_angle_zero(wavefront: svwfs.Wavefront) -> None:
    image = svwfs.psf(wavefront, x_m=0.5e-3, y_m=-0.5e-3)
    strehl = svwfs.to_dataset(wavefront)["strehl"].isel(view_row=0, view_column=2)
    assert image.sel(angle_x=0, angle_y=0).item() == pytest.approx(strehl.item(), rel=1e-4)
    with pytest.raises(ValueError, match="outside the field"):
        svwfs.psf(wavefront, x_m=1e-3, y_m=0.0)


def test_wavefront_is_evaluated_at_many_positions(bench: Bench, wavefront: svwfs.Wavefront) -> None:
    x_m, y_m = np.linspace(-0.5e-3, 0.5e-3, 3), np.array([[-0.5e-3], [0.4e-3]])
    found = wavefront.at(x_m, y_m)
    assert found.shape == (2, 3, 7, 7)
    one_by_one = [[wavefront.at(x, y) for x in x_m] for y in y_m[:, 0]]
    np.testing.assert_allclose(found, one_by_one, rtol=0, atol=1e-12)
    np.testing.assert_allclose(wavefront.at(bench.field.view_x_m, bench.field.view_y_m[:, None]), wavefront.views)
    with pytest.raises(ValueError, match=r"\(0.0007, -0.0005\) m lies outside the field"):
        wavefront.at([0.0, 0.7e-3], -0.5e-3)


def test_notebook_shows_wavefront(wavefront: svwfs.Wavefront) -> None:
    views = wavefront.views.copy()
    views[0, 0] = np.nan
    views[2, 1] = np.where(np.arange(7) < 3, -99.0, 99.0)
    shown = replace(wavefront, views=views)
    assert repr(shown).startswith("<Wavefront: 3 x 3 views of 7 x 7 lenslets, 49 valid; mean RMS ")
    html = shown._repr_html_()
    assert "&lt;Wavefront: 3 x 3 views" in html
    pixels = html_picture(html)
    px = pixels.shape[0] // 23  # of a lenslet: three views of 7, and a line after two
    assert pixels.shape == (23 * px, 23 * px, 3)
    centers = pixels[px // 2 :: px, px // 2 :: px]
    assert np.ptp(centers[:7, :7]) == 0  # unknown: grey
    assert centers[16, 8].tolist() == [0, 0, 255]  # negative at the left of the lower view: blue
    assert centers[16, 14].tolist() == [255, 0, 0]
    nothing = replace(wavefront, views=np.full_like(views, np.nan))
    assert "unknown" in repr(nothing)
    assert nothing._repr_html_()


@pytest.mark.parametrize(
    "image",
    [np.zeros((3, 240, 256)), np.zeros((0, 0)), 7, [[True] * 256] * 240, np.zeros((240, 256), complex)],
    ids=["stack", "empty", "number", "booleans", "complex"],
)
def test_image_that_is_none_is_refused(image: Any, bench: Bench, images: SimulatedFrames) -> None:
    sentence = r"must be an array \(row, column\) of counts"
    reconstruct = svwfs.reconstructor(bench, images.reference, dark=images.dark)
    with pytest.raises(svwfs.ReconstructionError, match=f"frame {sentence}"):
        reconstruct(image)
    with pytest.raises(svwfs.ReconstructionError, match=f"reference {sentence}"):
        svwfs.reconstructor(bench, image)
    with pytest.raises(svwfs.ReconstructionError, match=f"dark {sentence}"):
        svwfs.find_lattice(images.reference, bench, dark=image)


def test_clipped_frame_of_a_12_bit_camera_is_refused(bench: Bench, images: SimulatedFrames) -> None:
    scale = 4095 / np.quantile(images.frames[0], 0.9)
    clipped = np.minimum(images.frames[0] * scale, 4095).astype(np.uint16)
    reference = np.minimum(images.reference * scale * 0.5, 4095)
    reconstruct = svwfs.reconstructor(bench, reference, dark=images.dark * scale, full_scale=4095)
    with pytest.raises(svwfs.ReconstructionError, match="saturated"):
        reconstruct(clipped)


def test_full_scale_is_positive(bench: Bench, images: SimulatedFrames) -> None:
    for full_scale in (-1, 0, float("nan"), "4095"):
        with pytest.raises(svwfs.InputError, match=r"full_scale = .*: give the count at which a pixel saturates"):
            svwfs.reconstructor(bench, images.reference, full_scale=full_scale)  # type: ignore[arg-type] # refused
    unlimited = svwfs.reconstructor(bench, images.reference, dark=images.dark, full_scale=np.inf)
    assert unlimited(images.frames[0]).displacement.valid.all()


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize("rounds", [0, 2])
def test_command_gives_the_same_wavefront(
    images: SimulatedFrames, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, rounds: int
) -> None:
    counts = {"reference": images.reference, "frame": images.frames[0], "dark": images.dark}
    for name, image in counts.items():
        tifffile.imwrite(tmp_path / f"{name}.tif", np.rint(image).astype(np.uint16))
    reference, frame, dark = (tifffile.imread(tmp_path / f"{name}.tif") for name in counts)
    files = ["frame.tif", "--reference", "reference.tif", "--dark", "dark.tif", "--out", "r.nc"]
    monkeypatch.chdir(tmp_path)
    assert run(monkeypatch, "reconstruct", *files, "--bench", "small_demo", "--refine", str(rounds)) == 0
    with svwfs.open_result("r.nc") as result:
        expected = result["wavefront"].values, result["wavefront_sigma"].values
    reconstruct = svwfs.reconstructor(svwfs.load_bench("small_demo"), reference, dark=dark)
    wavefront = svwfs.refine(reconstruct, frame, rounds)
    np.testing.assert_allclose([wavefront.views, wavefront.sigma()], expected, rtol=0, atol=1e-6)


@pytest.mark.slow
def test_result_is_saved_with_the_bench_that_was_loaded(bench: Bench, images: SimulatedFrames, tmp_path: Path) -> None:
    """Rows, columns and pupil that it leaves open were found, and are saved."""
    loaded = replace(bench, sensor=replace(bench.sensor, lenslet_rows=None, lenslet_columns=None))
    wavefront = svwfs.reconstructor(loaded, images.reference, dark=images.dark)(images.frames[0])
    svwfs.save_result(tmp_path / "r.nc", wavefront, loaded)
    with svwfs.open_result(tmp_path / "r.nc") as result:
        (tmp_path / "b.toml").write_text(result.attrs["bench"])
        assert result["rms"].dims == ("view_row", "view_column")
    assert svwfs.load_bench(tmp_path / "b.toml").sensor == wavefront.sensor


@pytest.mark.slow
def test_saved_bench_has_the_lattice_in_force(bench: Bench, images: SimulatedFrames, tmp_path: Path) -> None:
    reconstruct = svwfs.reconstructor(bench, images.reference, dark=images.dark)
    svwfs.save_result(tmp_path / "r.nc", reconstruct(images.frames[0]), reconstruct.bench)
    with pytest.raises(svwfs.InputError, match=r"end the name with \.nc"):
        svwfs.save_result(tmp_path / "r.csv", reconstruct(images.frames[0]), reconstruct.bench)
    with svwfs.open_result(tmp_path / "r.nc") as result:
        (tmp_path / "b.toml").write_text(result.attrs["bench"])
    assert svwfs.load_bench(tmp_path / "b.toml").lattice == reconstruct.bench.lattice != bench.lattice


@pytest.mark.slow
@pytest.mark.long
def test_results_of_another_bench_are_not_taken_for_the_recordings_own(bench: Bench, tmp_path: Path) -> None:
    with svwfs.live(bench, average=2) as live:
        folder = live.record(tmp_path / "run", frames=2)
    recording = svwfs.open_recording(folder)
    own = recording.results()
    reconstruct = svwfs.reconstructor(
        svwfs.load_bench("small_demo", "registration.warp=translation"), recording.frames[0].values
    )
    svwfs.save_result(folder / "results.nc", reconstruct(recording.frames[0].values), reconstruct.bench)
    assert svwfs.open_recording(folder).results().equals(own)


def test_bench_may_be_a_presets_name_and_nothing_else(images: SimulatedFrames) -> None:
    assert svwfs.simulate("small_demo", noise_free=True).frames.shape == (1, 240, 256)  # type: ignore[arg-type] # a name
    with pytest.raises(svwfs.InputError, match="a bench is needed, as load_bench returns it, not dict"):
        svwfs.reconstructor({}, images.reference)  # type: ignore[arg-type] # no bench
    with pytest.raises(svwfs.InputError, match="write text"):
        svwfs.load_bench("small_demo", None)  # type: ignore[arg-type] # no text


@pytest.mark.parametrize(
    "use",
    [
        svwfs.to_dataset,
        lambda it: svwfs.psf(it, 0, 0),
        lambda it: svwfs.save_result("r.nc", it, svwfs.load_bench("small_demo")),
    ],
    ids=["to_dataset", "psf", "save_result"],
)
def test_missing_wavefront_is_refused(use: Callable[[Any], object]) -> None:
    with pytest.raises(svwfs.InputError, match=r"Measurement.problem"):
        use(None)


@pytest.mark.parametrize("number", ["3", 2.5, None, float("nan")])
def test_numbers_of_frames_and_rounds_are_whole(number: Any, bench: Bench, images: SimulatedFrames) -> None:
    with pytest.raises(svwfs.InputError, match="whole number"):
        svwfs.simulate(bench, number)
    reconstruct = svwfs.reconstructor(bench, images.reference, dark=images.dark)
    with pytest.raises(svwfs.InputError, match="whole number"):
        svwfs.refine(reconstruct, images.frames[0], number)


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.posix
def test_forked_process_can_reconstruct(tmp_path: Path) -> None:
    program = """
import os, svwfs
bench = svwfs.load_bench("small_demo")
images = svwfs.simulate(bench)
reconstruct = svwfs.reconstructor(bench, images.reference, dark=images.dark)
reconstruct(images.frames[0])
child = os.fork()
if not child:
    os._exit(int(not reconstruct(images.frames[0]).displacement.valid.all()))
raise SystemExit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""
    command = [sys.executable, "-W", "ignore", "-c", program]
    assert subprocess.run(command, timeout=HANG_S, check=False, cwd=tmp_path).returncode == 0  # noqa: S603 - our own


@pytest.mark.parametrize("path", ["missing.nc", "empty.nc"])
def test_open_result_names_an_unusable_file(path: str, tmp_path: Path) -> None:
    (tmp_path / "empty.nc").touch()
    with pytest.raises(svwfs.InputError, match=path):
        svwfs.open_result(tmp_path / path)
