"""No command replaces its inputs, or an existing file without --overwrite."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.command_line import run

from app.errors import Interrupted
from app.images import write_image
from app.recording.folder import FORMAT

INPUTS = ("frame.tif", "reference.tif", "dark.tif", "bench.toml", "estimator.png", "run/run.json", "run/frames.jsonl")
RECONSTRUCT = "reconstruct frame.tif --reference reference.tif --dark dark.tif --bench bench.toml --out"
CALIBRATE = "calibrate reference.tif --dark dark.tif --bench bench.toml"
ONTO_INPUTS = (
    *(f"{RECONSTRUCT} {name}" for name in INPUTS[:4]),
    *(f"{RECONSTRUCT} r.nc --plot {name}" for name in ("./frame.tif", "r.nc")),
    *(f"{CALIBRATE} {option}" for option in ("--out reference.tif", "--plot dark.tif", "--out bench.toml")),
    "replay run --out run/frames.zarr/0/zarr.json",
    "export run --to csv --out run/run.json",
    "field frame.tif --out f.nc --plot frame.tif",
    "replay run --bench bench.toml --out bench.toml",
    "export run --to netcdf --out recorded.nc",
    "deconvolve frame.tif --with run --scale 1e-6 --out recorded.nc",
    # files that the bench is made to name
    "simulate --bench bench.toml --out made --set simulation.screen.file=made/frame.tif",
    f"{RECONSTRUCT} mask.tif --set simulation.source.file=mask.tif",
    f"{CALIBRATE} --plot mask.png --set simulation.source.file=mask.png",
    "measure --bench bench.toml --frames 3 --out made --set simulation.screen.file=made/reference.tif",
    "live --bench bench.toml --seconds 1 --out made --set simulation.source.file=made/window.png",
    "replay run --set simulation.source.file=mask.tif --out mask.tif",
)
ONTO_EXISTING = (
    f"{RECONSTRUCT} old",
    f"{RECONSTRUCT} r.nc --plot old",
    f"{CALIBRATE} --out old",
    "simulate --bench small_demo --out .",
    "measure --bench small_demo --frames 3 --out .",
    "replay run --out old",
    "export run --to csv --out old",
    "field run --out f.nc --plot old",
    "report run --out old.pdf",
    "compare run run --plot old.pdf",
    "paper table1 --out study",
    "benchmark --json old",
    "live --seconds 1 --out window",
)
OF_ANOTHER_RECORDING = (
    f"{RECONSTRUCT} run/run.json",
    f"{RECONSTRUCT} r.nc --plot run/calibrations/0/r.png",
    f"{CALIBRATE} --out run/frames.zarr/zarr.json",
)
EXISTING = ("old", "old.pdf", "results.nc", "study/table1.png", "window/window.png")


@pytest.fixture
def folder(tmp_path: Path, small_toml: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working directory: some inputs and some files that exist already."""
    monkeypatch.chdir(tmp_path)
    for name in (*INPUTS, *EXISTING):
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_text("precious")
    for name in INPUTS[:3]:
        write_image(tmp_path / name, np.full((172, 240), 500, np.uint16))
    cv2.imwrite("estimator.png", np.full((8, 8), 255, np.uint8))
    shutil.copyfile(small_toml, "bench.toml")
    bench = small_toml.read_text() + '[simulation.source]\nmask = "image"\nfile = "recorded.nc"\n'
    Path("run/run.json").write_text(json.dumps({"format": FORMAT, "complete": True, "bench": bench}))
    return tmp_path


def contents(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("command", ONTO_INPUTS)
def test_no_input_is_overwritten(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], folder: Path, command: str
) -> None:
    before = contents(folder)
    assert run(monkeypatch, *command.split(), "--overwrite") == 2
    assert "is used by this command already; give the output another name" in capsys.readouterr().err
    assert contents(folder) == before


@pytest.mark.parametrize("command", OF_ANOTHER_RECORDING)
def test_no_part_of_another_recording_is_overwritten(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], folder: Path, command: str
) -> None:
    before = contents(folder)
    assert run(monkeypatch, *command.split(), "--overwrite") == 2
    assert "is part of a recording; give the output another name" in capsys.readouterr().err
    assert contents(folder) == before


@pytest.mark.parametrize(
    ("command", "told"),
    [
        (f"{RECONSTRUCT} a.nc --out b.nc", "--out is given 2 times: give it once"),
        (f"{RECONSTRUCT} new/", "--out new/: no such folder; leave the slash out of a file's name"),
        (f"{RECONSTRUCT} r.tif", "r.tif: .tif does not fit the format: end the name with .nc"),
        (f"{CALIBRATE} --out r.nc", "end the name with .toml"),
        ("benchmark --json b.csv", "end the name with .json"),
        ("replay run --out r.csv", "end the name with .nc"),
        ("export run --to csv --out r.nc", "end the name with .csv"),
        ("export run --to psf --out r.nc", "end the name with .tif"),
        ("deconvolve frame.tif --with run --out r.nc", "end the name with .tif"),
        *((f"report run --out {name}", "ends in one of .pdf, .png") for name in ("r.html", "r")),
        ("layers run --out=", "--out is empty: give the name of a file or folder"),
        ("layers run --out r.nc --distance 0.1 --distance nan", "--distance: give a finite number"),
        ("corrector run --out r.nc --distance=-inf", "--distance: give a finite number"),
        ("layers run --out r.nc --distance far", "--distance"),
    ],
)
def test_output_that_cannot_be_meant_is_refused(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], folder: Path, command: str, told: str
) -> None:
    before = contents(folder)
    assert run(monkeypatch, *command.split()) == 2
    assert told in " ".join(capsys.readouterr().err.split())
    assert contents(folder) == before


@pytest.mark.slow
def test_folder_may_end_with_a_slash_and_settings_may_be_repeated(
    monkeypatch: pytest.MonkeyPatch, folder: Path
) -> None:
    more = ("--set", "camera.em_gain=1", "--set", "camera.em_gain=2", "--overwrite", "--overwrite")
    assert run(monkeypatch, "simulate", "--bench", "bench.toml", "--out", "new/", *more) == 0
    assert (folder / "new" / "truth.nc").exists()


def test_interrupted_simulation_leaves_no_half_set(monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
    """Ctrl-C comes when all frames are rendered, and the truth is computed."""
    before = contents(folder)

    def interrupt(*_: object) -> None:
        raise Interrupted("interrupted")

    monkeypatch.setattr("app.results.dataset.truth_dataset", interrupt)
    assert run(monkeypatch, "simulate", "--bench", "bench.toml", "--out", "new") == 130
    assert contents(folder) == before


@pytest.mark.parametrize("command", ONTO_EXISTING)
def test_existing_file_needs_overwrite(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], folder: Path, command: str
) -> None:
    before = contents(folder)
    assert run(monkeypatch, *command.split()) == 2
    errors = capsys.readouterr().err
    assert "exists already; --overwrite replaces it" in errors
    assert errors.count("\n") == 1
    assert contents(folder) == before


@pytest.mark.slow
def test_overwrite_replaces_results(monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
    assert run(monkeypatch, "simulate", "--bench", "bench.toml", "--out", ".", "--overwrite") == 0
    assert run(monkeypatch, *RECONSTRUCT.split(), "old", "--overwrite") == 0
    assert (folder / "old").read_bytes().startswith(b"\x89HDF")


def test_live_run_never_replaces_a_recording(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], folder: Path
) -> None:
    assert run(monkeypatch, "live", "--seconds", "1", "--out", folder / "run", "--overwrite") == 2
    assert "run: holds a recording; choose another folder with --out" in capsys.readouterr().err
