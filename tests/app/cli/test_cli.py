"""The command line: files written, messages, and exit status."""

from __future__ import annotations

import itertools
import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
import typer.main
import xarray as xr
from support.command_line import run
from support.paths import FOREIGN_FRAMES
from support.patience import HANG_S, wait_until
from support.pictures import assert_drawn
from support.simulated_faults import unplug

from app.acquisition import start_up
from app.acquisition.devices import open_devices
from app.acquisition.instrument import Instrument
from app.acquisition.worker import Acquisition
from app.bench.config import Bench, load_bench, write_bench
from app.bench.device_kinds import DeviceSettings
from app.bench.presets import PRESETS
from app.cli.application import cli
from app.errors import Interrupted, RunError
from app.recording.writer import Record, RecordingWriter
from drivers.dcam import DcamSettings
from drivers.genicam import GenicamSettings
from drivers.interface import Devices, Disconnected, Frame
from drivers.micro_manager import MicroManagerSettings
from drivers.serial_lights import CoolLEDSettings, DC4100Settings
from drivers.usb_lights import DC2200Settings
from reconstruction.wavefront import rms
from simulated_devices.camera import SimulatedCamera

FRAMES = FOREIGN_FRAMES


def reconstruct_foreign(out: Path, *more: str | Path) -> tuple[str | Path, ...]:
    """Arguments that reconstruct the foreign frames."""
    reference = FRAMES / "square_reference.tif"
    return (
        "reconstruct",
        FRAMES / "square_frame.tif",
        *("--reference", reference, "--bench", FRAMES / "bench.toml", "--out", out, *more),
    )


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize(
    ("changes", "figure_rad"),
    [
        (("registration.warp=affine", "reconstruction.pupil_modes=45"), 0.20),
        (("registration.warp=affine", "reconstruction.method=zonal"), 0.21),
    ],
)
def test_reconstruct_matches_truth(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    changes: tuple[str, ...],
    figure_rad: float,
) -> None:
    settings = [word for change in changes for word in ("--set", change)]
    out, picture = tmp_path / "deep" / "r.nc", tmp_path / "p.png"
    assert run(monkeypatch, *reconstruct_foreign(out, *settings, "--plot", picture)) == 0
    with xr.open_dataset(out) as result:
        residual = rms(result["wavefront"].to_numpy() - np.load(FRAMES / "truth.npz")["wavefront_rad"])
    assert residual.mean() < figure_rad
    assert "225 of 225 lenslets valid" in capsys.readouterr().out
    assert_drawn(picture)


def test_reconstructing_simulated_frame_gives_truth(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, small_toml: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, "simulate", "--bench", small_toml, "--out", tmp_path) == 0
    names = {"dark.tif", "reference.tif", "frame.tif", "truth.nc"}
    assert {path.name for path in tmp_path.iterdir()} == names
    assert tifffile.imread(tmp_path / "frame.tif").dtype == np.uint16
    assert "light at the lenslets: " in capsys.readouterr().out
    files = ("--reference", tmp_path / "reference.tif", "--dark", tmp_path / "dark.tif", "--bench", small_toml)
    assert run(monkeypatch, "reconstruct", tmp_path / "frame.tif", *files, "--out", tmp_path / "r.nc") == 0
    with xr.open_dataset(tmp_path / "r.nc") as result, xr.open_dataset(tmp_path / "truth.nc") as truth:
        assert result["wavefront"].dims == truth["wavefront"].dims == truth["light"].dims
        assert 0.001 < float(abs(truth["light"] - 1).mean()) < 0.2  # the screen gathers and spreads it
        assert truth.attrs["propagation_of_light"] == "from sample to lenslets"
        residual = rms((result["wavefront"] - truth["wavefront"]).to_numpy())
        assert residual.mean() < 0.1 * rms(truth["wavefront"].to_numpy()).mean()


def test_noise_free_images_are_float_photons(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, small_toml: Path) -> None:
    assert run(monkeypatch, "simulate", "--bench", small_toml, "--out", tmp_path, "--noise-free") == 0
    assert tifffile.imread(tmp_path / "frame.tif").dtype == np.float32
    assert tifffile.imread(tmp_path / "dark.tif").max() == 0


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.usefixtures("no_hurry")
def test_measure_writes_results(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, small_toml: Path
) -> None:
    assert (
        run(monkeypatch, "measure", "--bench", small_toml, "--frames", "5", "--out", tmp_path / "m", "--auto-expose")
        == 0
    )
    with xr.open_dataset(tmp_path / "m" / "results.nc") as results:
        assert results["wavefront"].shape == (5, 3, 3, 5, 7)
        rms_rad = results["rms"].mean(["view_row", "view_column"]).to_numpy()
        assert rms_rad == pytest.approx(1.5, rel=0.1)  # RMS of the bench's screen
        assert results["frame_index"].to_numpy().tolist() == list(range(5))
    line = json.loads((tmp_path / "m" / "frames.jsonl").read_text().splitlines()[-1])
    said = capsys.readouterr().out
    assert "5 frames, 0 lost by the camera" in said
    assert f"exposure {line['exposure_s'] * 1e3:.4g} ms, light current {line['light_current_a']:.4g} A" in said
    assert "camera and light are simulated" in said
    assert tifffile.imread(tmp_path / "m" / "reference.tif").shape == (172, 240)
    record = json.loads((tmp_path / "m" / "run.json").read_text())
    assert record["frames"] == {"acquired": 5, "recorded": 5, "reconstructed": 5, "lost": 0}
    assert record["timings"]["register"]["count"] >= 5
    assert 0 < record["timings"]["register"]["p50_s"] <= record["timings"]["to_result"]["max_s"]
    assert record["timings"]["draw"] == {"count": 0, "p50_s": None, "p99_s": None, "max_s": None}
    assert {"python", "numpy", "numba"} <= set(record["versions"])


@pytest.mark.slow
@pytest.mark.usefixtures("no_hurry")
def test_late_start_of_the_recording_costs_no_frame(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, small_toml: Path
) -> None:
    start = Acquisition.start_recording

    def start_late(acquisition: Acquisition, *arguments: Any, **how: Any) -> Future[None]:
        acquisition.submit(lambda _: None).result(HANG_S)  # what was asked for before is done
        time.sleep(0.3)
        return start(acquisition, *arguments, **how)

    monkeypatch.setattr(Acquisition, "start_recording", start_late)
    assert run(monkeypatch, "measure", "--bench", small_toml, "--frames", "3", "--out", tmp_path / "m") == 0
    with xr.open_dataset(tmp_path / "m" / "results.nc") as results:
        assert results["frame_index"].to_numpy().tolist() == [0, 1, 2]


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.usefixtures("no_hurry")
def test_measure_that_recorded_nothing_can_be_repeated(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, small_toml: Path
) -> None:
    def fail(*_: object) -> None:
        raise Disconnected("the camera is gone")

    command = ("measure", "--bench", small_toml, "--frames", "3", "--out", tmp_path / "m")
    with monkeypatch.context() as unplugged:
        unplugged.setattr(Instrument, "_set_running", fail)
        assert run(monkeypatch, *command) == 1
    assert "the camera is gone" in capsys.readouterr().err
    assert not (tmp_path / "m").exists()
    assert run(monkeypatch, *command) == 0


@pytest.mark.slow
@pytest.mark.usefixtures("no_hurry")
def test_measure_never_overwrites_recording(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, small_toml: Path
) -> None:
    command = ("measure", "--bench", small_toml, "--frames", "3", "--out", tmp_path / "m")
    assert run(monkeypatch, *command) == 0
    assert run(monkeypatch, "recover", tmp_path / "m") == 0
    assert "was complete: 3 frames, 3 of them reconstructed live; no gaps" in capsys.readouterr().out
    assert run(monkeypatch, *command) == 2
    assert "holds a recording already" in capsys.readouterr().err
    assert run(monkeypatch, "recover", tmp_path) == 2
    assert "holds no recording" in capsys.readouterr().err


def test_interrupted_measure_names_folder_of_frames(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, small_toml: Path
) -> None:
    def interrupt(*_: object, **__: object) -> None:
        raise Interrupted("interrupted")

    monkeypatch.setattr("app.results.frame_tallies.write_pieces", interrupt)
    assert run(monkeypatch, "measure", "--bench", small_toml, "--frames", "3", "--out", tmp_path / "m") == 130
    assert "m holds 3 frames; svwfs replay" in capsys.readouterr().err.replace("\n", " ")
    assert not (tmp_path / "m" / "results.nc").exists()


def test_measure_on_full_disk_names_folder_of_frames(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, small_toml: Path
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise RunError("results.nc: cannot be written: no space left")

    monkeypatch.setattr("app.results.frame_tallies.write_pieces", refuse)
    assert run(monkeypatch, "measure", "--bench", small_toml, "--frames", "3", "--out", tmp_path / "m") == 1
    said = capsys.readouterr().err.replace("\n", " ")
    assert "no space left" in said
    assert "m holds 3 frames; svwfs replay" in said


@pytest.mark.usefixtures("no_hurry")
def test_measure_whose_list_of_frames_is_deleted_says_so(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, small_toml: Path
) -> None:
    put = RecordingWriter.write

    def delete(writer: RecordingWriter, record: Record) -> None:
        put(writer, record)
        if writer.frames == 2:
            (tmp_path / "m" / "frames.jsonl").unlink()

    monkeypatch.setattr(RecordingWriter, "write", delete)
    assert run(monkeypatch, "measure", "--bench", small_toml, "--frames", "4", "--out", tmp_path / "m") == 1
    lines = tmp_path / "m" / "frames.jsonl"
    why = "was removed or renamed during the recording; svwfs recover finishes it"
    assert capsys.readouterr().err == f"svwfs: {lines}: {why}\n"
    assert not lines.exists()


@pytest.mark.slow
@pytest.mark.long
def test_measure_refines_every_frame(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, small_toml: Path) -> None:
    command = ("measure", "--bench", small_toml, "--frames", "5", "--out", tmp_path / "m")
    assert run(monkeypatch, *command, "--set", "reconstruction.refine=true") == 0
    with xr.open_dataset(tmp_path / "m" / "results.nc") as results:
        assert np.all(results["bias_age"].to_numpy() >= 0)


@pytest.mark.slow
@pytest.mark.long
def test_reconstruct_refine_limits_rounds(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    files = (
        FRAMES / "square_frame.tif",
        "--reference",
        FRAMES / "square_reference.tif",
        "--bench",
        FRAMES / "bench.toml",
        "--set",
        "registration.warp=quartic",
        "--set",
        "reconstruction.pupil_modes=automatic",
    )
    assert run(monkeypatch, "reconstruct", *files, "--out", tmp_path / "r.nc", "--refine", "1") == 0
    assert "refined in 1 round," in capsys.readouterr().out.replace("\n", " ")  # of two without the limit
    with xr.open_dataset(tmp_path / "r.nc") as results:
        assert results.attrs["refinement_rounds"] == 1
        residual = results["wavefront"].to_numpy() - np.load(FRAMES / "truth.npz")["wavefront_rad"]
    assert residual.std(axis=(2, 3)).mean() < 0.012  # another simulator's frames


@pytest.mark.slow
@pytest.mark.long
def test_ctrl_c_saves_measured_frames(tmp_path: Path, small_toml: Path) -> None:
    command = [sys.executable, "-c", "from app.cli import main; main()", "measure", "--bench", str(small_toml)]
    process = subprocess.Popen(  # noqa: S603 - our own program
        [*command, "--frames", "100000", "--out", str(tmp_path / "m")], stderr=subprocess.PIPE, text=True
    )
    lines = tmp_path / "m" / "frames.jsonl"
    wait_until(lambda: lines.exists() and lines.read_text().count("\n") >= 3)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=HANG_S)
    assert process.returncode == 130
    said = re.search(r"svwfs: stopped: (\d+) of 100000 frames are in", errors)
    assert said is not None
    with xr.open_dataset(tmp_path / "m" / "results.nc") as results:
        assert results.sizes["frame"] == int(said[1]) > 0


@pytest.mark.slow
@pytest.mark.long
def test_unplugged_camera_keeps_measured_frames(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, small_toml: Path
) -> None:
    def open_then_unplug(bench: Bench, progress: Callable[[float], None]) -> Devices:
        devices = open_devices(bench, progress)
        camera, read = devices.camera, devices.camera.read
        assert isinstance(camera, SimulatedCamera)
        left = itertools.count(2 * start_up.FRAMES + 5, -1)  # frames until it is unplugged

        def read_while_plugged(timeout_s: float) -> Frame:
            frame = read(timeout_s)
            if next(left) == 0:
                unplug(camera)
            return frame

        monkeypatch.setattr(camera, "read", read_while_plugged)
        return devices

    monkeypatch.setattr("app.acquisition.devices.open_devices", open_then_unplug)
    assert run(monkeypatch, "measure", "--bench", small_toml, "--frames", "50", "--out", tmp_path / "m") == 1
    errors = capsys.readouterr().err
    assert "svwfs: " in errors
    assert "camera" in errors
    assert "Traceback" not in errors
    with xr.open_dataset(tmp_path / "m" / "results.nc") as results:
        assert results.sizes["frame"] in {5, 6}


def test_measure_without_light_fails_with_a_reason(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, small_toml: Path
) -> None:
    command = ("measure", "--bench", small_toml, "--frames", "3", "--out", tmp_path / "m")
    assert run(monkeypatch, *command, "--set", "light.current_a=0.0") == 1
    assert "was the light on" in capsys.readouterr().err
    assert not (tmp_path / "m" / "results.nc").exists()


def test_selftest_passes(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(monkeypatch, "selftest") == 0
    assert capsys.readouterr().out.count("ok") == 6


def _nan(image: np.ndarray) -> np.ndarray:
    image[3, 4] = np.nan
    return image


BAD_FRAMES = {
    "no such file": None,
    "cannot be read as TIFF, NPY, FITS, PNG, BMP or PGM": b"not an image",
    "has 100 x 512 pixels": lambda image: image[:100],
    "not finite": _nan,
    "3 x 512 x 512; one grey image": lambda image: np.stack([image] * 3),
    "is the light on": lambda image: np.random.default_rng(0).normal(0.01, 0.001, image.shape),
    "saturated": lambda image: np.minimum(image * 3e5, 65535).astype(np.uint16),
}


@pytest.mark.parametrize("sentence", BAD_FRAMES)
def test_bad_frame_exits_with_status_2(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, sentence: str
) -> None:
    path, make = tmp_path / "bad.tif", BAD_FRAMES[sentence]
    reference = FRAMES / "square_reference.tif"
    if isinstance(make, bytes):
        path.write_bytes(make)
    elif make is not None:
        image = make(tifffile.imread(FRAMES / "square_frame.tif"))
        tifffile.imwrite(path, image, photometric="minisblack")
        if image.dtype == np.uint16:  # the same camera, with an unsaturated reference
            reference = tmp_path / "reference.tif"
            tifffile.imwrite(reference, (tifffile.imread(FRAMES / "square_reference.tif") * 3e4).astype(np.uint16))
    out = tmp_path / "r.nc"
    command = ("--reference", reference, "--bench", FRAMES / "bench.toml", "--out", out)
    assert run(monkeypatch, "reconstruct", path, *command) == 2
    errors = capsys.readouterr().err
    assert errors.startswith(f"svwfs: {path}: ")
    assert sentence in errors
    assert errors.count("\n") == 1
    assert not out.exists()
    assert not list(tmp_path.glob(".*"))


def test_dark_reference_is_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    path = tmp_path / "dark_reference.tif"
    tifffile.imwrite(path, np.random.default_rng(0).normal(500, 6, (512, 512)).astype(np.uint16))
    command = ("--reference", path, "--bench", FRAMES / "bench.toml", "--out", tmp_path / "r.nc")
    assert run(monkeypatch, "reconstruct", FRAMES / "square_frame.tif", *command) == 2
    assert capsys.readouterr().err.startswith(f"svwfs: {path}: the reference shows no light")


@pytest.mark.parametrize(
    ("command", "sentence"),
    [
        (("measure", "--bench", "nowhere.toml", "--frames", "3", "--out", "x"), "nowhere.toml: no such file"),
        (("measure", "--bench", "live_demo", "--frames", "0", "--out", "x"), "Invalid value for '--frames'"),
        (("simulate", "--bench", "live_demo", "--set", "sensor.colour=3", "--out", "x"), "sensor.colour is an unknown"),
        (("nonsense",), "No such command"),
    ],
)
def test_bad_arguments_exit_with_status_2(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], command: tuple[str, ...], sentence: str
) -> None:
    assert run(monkeypatch, *command) == 2
    assert sentence in capsys.readouterr().err


GROUP = typer.main.get_command(cli)


def commands(group: Any = GROUP, path: str = "svwfs") -> Iterator[tuple[str, Any]]:
    """Every command of the command line, those of subgroups included, with its full name."""
    for name, command in group.commands.items():
        if hasattr(command, "commands"):
            yield from commands(command, f"{path} {name}")
        else:
            yield f"{path} {name}", command


def test_help_names_every_command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(monkeypatch, "--help") == 0
    listed = re.findall(r"^\W*([\w-]+) {2,}\S", capsys.readouterr().out, re.MULTILINE)
    assert set(GROUP.commands) <= set(listed)  # type: ignore[attr-defined] # it is a group
    assert len(GROUP.commands) >= 16  # type: ignore[attr-defined] # it is a group


@pytest.mark.parametrize("name", dict(commands()))
def test_help_of_command_has_valid_examples(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    command = dict(commands())[name]
    assert run(monkeypatch, *name.split()[1:], "--help") == 0
    shown = capsys.readouterr().out
    assert all(option in shown for parameter in command.params for option in parameter.opts if option[:2] == "--")
    examples = re.findall(r"Example: (svwfs .*?)(?:\n\n|$)", command.help.strip(), re.DOTALL)
    assert examples
    for example in examples:
        words = shlex.split(example)
        assert " ".join(words).startswith(name)
        command.make_context(name, words[len(name.split()) :])  # exits if it cannot be parsed


def test_no_example_checks_the_simulated_device_of_a_preset() -> None:
    words = shlex.split(str(dict(commands())["svwfs devices"].help))
    benches = [after for word, after in itertools.pairwise(words) if word == "--bench"]
    assert benches
    assert not set(benches) & set(PRESETS)


REAL_DEVICES: list[tuple[DeviceSettings, DeviceSettings]] = [
    (DcamSettings(), DC4100Settings(port="COM1")),
    (GenicamSettings(), DC2200Settings()),
    (GenicamSettings(), CoolLEDSettings(port="COM1")),
    (MicroManagerSettings(adapter="DemoCamera", device="DCam", properties={"Gain": "2"}), DC2200Settings()),
]
LOAD_BENCHES = "from app.bench.config import load_bench; [load_bench(path) for path in sys.argv[1:]]"
SHOW_HELP = "from app.cli.application import cli; cli(['--help'], standalone_mode=False)"


@pytest.mark.parametrize("program", [LOAD_BENCHES, SHOW_HELP, SHOW_HELP.replace("['", "['measure', '")])
def test_reading_bench_and_help_load_no_devices_numba_or_qt(tmp_path: Path, program: str) -> None:
    paths = ["live_demo", *(str(tmp_path / f"{index}.toml") for index in range(len(REAL_DEVICES)))]
    for path, (camera, light) in zip(paths[1:], REAL_DEVICES, strict=True):
        Path(path).write_text(write_bench(replace(load_bench("live_demo"), camera=camera, light=light)))
    loaded = "sys.exit(str([name for name in ('usb', 'serial', 'pymmcore', 'numba', 'PyQt6') if name in sys.modules]))"
    command = [sys.executable, "-c", f"import sys; {program}; {loaded}", *paths]
    finished = subprocess.run(command, check=False, capture_output=True, text=True)  # noqa: S603 - our own program
    assert finished.stderr == "[]\n"


def test_command_without_recordings_is_refused_before_anything_is_loaded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not even what the work needs; `batch` would start its workers next."""
    monkeypatch.chdir(tmp_path)
    loaded = "[name for name in ('numba', 'scipy', 'xarray', 'distributed') if name in sys.modules]"
    for words in ("batch nowhere neither --out r.zarr", "replay nowhere", "report nowhere --out r.pdf"):
        program = f"import atexit, sys; atexit.register(lambda: print({loaded})); from app.cli import main; main()"
        command = [sys.executable, "-c", program, *words.split()]
        done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603 - our own program
        assert (done.returncode, done.stdout) == (2, "[]\n"), done.stderr
        assert done.stderr.startswith("svwfs: nowhere: no such folder")


def test_programs_that_commands_start_import_nothing_from_the_working_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    assert run(monkeypatch, "--version") == 0
    assert os.environ["PYTHONSAFEPATH"] == "1"


MEASURE = "app.acquisition.start_up, app.acquisition.streams.publisher, app.results.frame_tallies"
WINDOW = "app.acquisition.worker, app.gui.application"
STATISTICS = ("scipy.optimize", "scipy.signal", "scipy.stats")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rooms", "unwanted"),
    [
        pytest.param(MEASURE, ("PyQt6", "matplotlib", *STATISTICS), id="measure"),
        pytest.param(WINDOW, ("matplotlib", "xarray", "pandas", "h5py", "zarr", *STATISTICS), id="window"),
    ],
)
def test_first_picture_waits_for_nothing_that_it_does_not_need(rooms: str, unwanted: tuple[str, ...]) -> None:
    """In a process of its own, loading what is not wanted takes most of a second."""
    program = (
        f"import sys, app.cli.application, {rooms}; sys.exit(any(name.startswith({unwanted}) for name in sys.modules))"
    )
    finished = subprocess.run([sys.executable, "-c", program], check=False)  # noqa: S603 - our own program
    assert finished.returncode == 0


def test_error_is_one_line_without_control_codes(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, "recover", "a\x1b[31m\nb\udcff") == 2
    assert capsys.readouterr().err == "svwfs: a\\x1b[31m\\nb\\udcff: no such folder\n"


def test_lack_of_memory_is_one_line(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def exhaust(*_: object, **__: object) -> None:
        raise MemoryError("Unable to allocate 9 TiB")

    monkeypatch.setattr("app.recording.recover.recover", exhaust)
    assert run(monkeypatch, "recover", "run") == 1
    assert capsys.readouterr().err == "svwfs: there is not enough memory: Unable to allocate 9 TiB\n"


@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_output_that_cannot_be_printed_is_one_line(unbuffered: str) -> None:
    program = "import sys; from app.cli import main; main()"
    command = [sys.executable, "-c", program, "devices", "--help"]
    environment = os.environ | {"PYTHONUNBUFFERED": unbuffered}
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, env=environment, check=False)  # noqa: S603 - our own command
    assert (done.returncode, done.stderr) == (1, "svwfs: the output cannot be printed: No space left on device\n")


def test_closed_pipe_ends_silently() -> None:
    program = "import sys, app.cli.application as all; from app.cli import main\n"
    program += "all.cli = lambda: sys.stdout.write('result') and sys.exit(); main()"  # as commands that do not flush
    reading, writing = os.pipe()
    os.close(reading)
    try:
        done = subprocess.run([sys.executable, "-c", program], stdout=writing, stderr=subprocess.PIPE, check=False)  # noqa: S603 - our own program
    finally:
        os.close(writing)
    assert (done.returncode, done.stderr) == (1, b"")


@pytest.mark.parametrize("command", ["replay {}", "layers {} --out o.nc", "study calibration --frames {} --out o"])
def test_too_long_a_name_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], command: str
) -> None:
    assert run(monkeypatch, *command.format("x" * 300).split()) == 2
    assert re.fullmatch(r"svwfs: x{300}\S*: cannot be used: File name too long\n", capsys.readouterr().err)


@pytest.mark.parametrize("path", ["screen.file", "screen.transmission_file", "source.file"])
def test_null_character_in_a_bench_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, path: str
) -> None:
    bad = f'simulation.{path}="a\\u0000b"'
    assert run(monkeypatch, "simulate", "--bench", "small_demo", "--out", tmp_path / "o", "--set", bad) == 2
    error = f"svwfs: small_demo: simulation.{path} must be text in quotes without null characters\n"
    assert capsys.readouterr().err == error


def test_ctrl_c_while_the_commands_are_imported_is_one_line() -> None:
    program = "import os, signal, sys; from app.cli import main; sys.argv = ['svwfs', 'selftest']\n"
    program += "class Interrupting:\n    def find_spec(self, name, *_):\n"
    program += "        if name == 'typer': os.kill(os.getpid(), signal.SIGINT)\n"
    program += "sys.meta_path.insert(0, Interrupting()); main()"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)  # noqa: S603 - our own program
    assert (done.returncode, done.stderr) == (130, "svwfs: interrupted\n")


@pytest.mark.parametrize(("kind", "shift"), [(np.uint8, 8), (np.int16, 1)])
def test_frame_of_a_smaller_type_than_the_reference_is_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, kind: type, shift: int
) -> None:
    reference = (tifffile.imread(FRAMES / "square_reference.tif") * 1e5).clip(0, 60000).astype(np.uint16)
    tifffile.imwrite(tmp_path / "reference.tif", reference)
    tifffile.imwrite(tmp_path / "frame.tif", (reference >> shift).astype(kind))
    command = ("--reference", tmp_path / "reference.tif", "--bench", FRAMES / "bench.toml", "--out", tmp_path / "r.nc")
    assert run(monkeypatch, "reconstruct", tmp_path / "frame.tif", *command) == 2
    assert "values up to 60000: save both in the same form" in capsys.readouterr().err


@pytest.mark.parametrize("factor", [2.0**16, 1e7])
def test_frame_of_another_scale_than_the_reference_is_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, factor: float
) -> None:
    for name, peak in (("reference", 4e4), ("frame", 3e4 * factor)):
        image = tifffile.imread(FRAMES / f"square_{name}.tif").astype(np.float32)
        tifffile.imwrite(tmp_path / f"{name}.tif", image * np.float32(peak / image.max()))
    command = ("--reference", tmp_path / "reference.tif", "--bench", FRAMES / "bench.toml", "--out", tmp_path / "r.nc")
    assert run(monkeypatch, "reconstruct", tmp_path / "frame.tif", *command) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"svwfs: {tmp_path / 'reference.tif'}: holds float32 values up to ")
    assert said.endswith(": save both in the same form\n")


@pytest.mark.parametrize(("setting", "is_told"), [("camera.rows=100", True), ("camera.exposure_s=0.1", False)])
def test_frame_of_another_size_than_the_bench_is_told(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, setting: str, is_told: bool
) -> None:
    assert run(monkeypatch, *reconstruct_foreign(tmp_path / "r.nc", "--set", setting)) == 0
    assert ("bench's camera 100 x 512: is this its bench?" in capsys.readouterr().err) == is_told


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize(("kind", "full"), [(np.uint16, 65535), (np.float32, 65535), (np.uint8, 255)])
def test_hot_pixel_in_the_reference_is_no_reason_to_refuse(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, kind: type, full: int
) -> None:
    frame, reference = (tifffile.imread(FRAMES / f"square_{name}.tif") for name in ("frame", "reference"))
    scale = 0.8 * min(full, 60000) / reference.max()
    reference = np.rint(reference * scale).astype(kind)
    reference[3, 3] = full
    tifffile.imwrite(tmp_path / "reference.tif", reference)
    form = np.uint8 if kind is np.uint8 else np.uint16
    tifffile.imwrite(tmp_path / "frame.tif", np.rint(frame * scale).clip(0, full).astype(form))
    command = ("--reference", tmp_path / "reference.tif", "--bench", FRAMES / "bench.toml", "--out", tmp_path / "r.nc")
    assert run(monkeypatch, "reconstruct", tmp_path / "frame.tif", *command) == 0


@pytest.mark.slow
@pytest.mark.long
def test_unjudged_misfit_and_a_repeated_reference_are_told(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    for warp, is_told in (("affine", False), ("translation", True)):
        command = reconstruct_foreign(tmp_path / f"{warp}.nc", "--set", f"registration.warp={warp}")
        assert run(monkeypatch, *command) == 0
        assert ("note: misfit is not judged: " in capsys.readouterr().out) == is_told
    command = reconstruct_foreign(tmp_path / "again.nc")
    assert run(monkeypatch, command[0], FRAMES / "square_reference.tif", *command[2:]) == 0
    assert "doubtful: the frame is the reference itself" in capsys.readouterr().out
