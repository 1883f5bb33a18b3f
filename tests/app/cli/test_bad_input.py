"""Bad input ends in one clear line and the right status: no traceback, and no half-written file."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from support.command_line import run
from support.recordings import record

RECONSTRUCT = "reconstruct frame.tif --reference reference.tif --dark dark.tif --bench bench.toml --out out.nc"
CALIBRATE = "calibrate reference.tif --dark dark.tif --bench bench.toml --out out.toml"
OF_RECORDINGS = (
    "replay run --out out.nc",
    "export run --to csv --out out.csv",
    "field run --out out.nc",
    "recover run",
)

DAMAGES: dict[str, Callable[[Path], object]] = {
    "missing": lambda path: path.unlink(),
    "empty": lambda path: path.write_bytes(b""),
    "cut in half": lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]),
    "text": lambda path: path.write_bytes(b"no such thing\n"),
}
PARTS = (
    "run.json",
    "frames.jsonl",
    "frames.zarr/0/c/0/0/0",
    "calibrations/0/reference.npz",
    "calibrations/0/bench.toml",
)
SETTINGS = (
    "camera.bits=nan",
    "sensor.lenslet_rows=-1",
    "field.half_width_m=1e300",
    'sensor.pixel_pitch_m="text"',
    "a=b",
)
WORDS = (
    *(RECONSTRUCT.replace("out.nc", name) for name in ("n" * 300, "no/\x1b[31mx/out.nc", "/dev/null", "frame.tif/x")),
    *(RECONSTRUCT.replace("bench.toml", name) for name in ("nowhere.toml", "live_demo2", "frame.tif", "run", ".")),
    *(f"{RECONSTRUCT} --plot p.{suffix}" for suffix in ("jpg", "txt")),
    *(f"replay run --frames {frames}" for frames in ("a", "5:2", "1:2:3", "99:", "1e3:")),
)


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory, quick_toml: Path) -> Path:
    """Good inputs: a bench, three images and a recording."""
    folder = tmp_path_factory.mktemp("prepared")
    shutil.copyfile(quick_toml, folder / "bench.toml")
    with pytest.MonkeyPatch.context() as patch:
        assert run(patch, "simulate", "--bench", folder / "bench.toml", "--out", folder) == 0
    record(folder / "bench.toml", folder / "run", frames=2)
    return folder


@pytest.fixture
def folder(prepared: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    shutil.copytree(prepared, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def one_line(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], command: str, *more: str) -> int:
    """Run a command that may fail, and return its status."""
    status = run(monkeypatch, *command.split(" "), *more)
    output, errors = capfd.readouterr()
    lines = [line for line in errors.splitlines() if line and not line.startswith("note: ")]
    assert status in {0, 1, 2}, command
    assert "\x1b" not in output + errors, command
    assert status == 0 or lines[-1].startswith("Error: ") or (len(lines) == 1 and lines[0].startswith("svwfs: ")), lines
    assert not list(Path().rglob(".*.partial*")), command
    return status


@pytest.mark.slow
@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_image_is_one_line(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], damage: str
) -> None:
    DAMAGES[damage](folder / "reference.tif")
    for command in (RECONSTRUCT, CALIBRATE):
        assert one_line(monkeypatch, capfd, command) == 2


@pytest.mark.slow
@pytest.mark.parametrize("part", PARTS)
def test_damaged_recording_is_one_line(
    folder: Path, prepared: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], part: str
) -> None:
    for damage in ("missing", "empty", "cut in half"):
        for command in OF_RECORDINGS:
            DAMAGES[damage](folder / "run" / part)
            one_line(monkeypatch, capfd, command)
            shutil.rmtree(folder / "run")
            shutil.copytree(prepared / "run", folder / "run")
            for name in ("out.nc", "out.csv"):
                (folder / name).unlink(missing_ok=True)


@pytest.mark.slow
def test_odd_arguments_and_settings_are_one_line(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    for command in WORDS:
        one_line(monkeypatch, capfd, command)
    for setting in SETTINGS:
        assert one_line(monkeypatch, capfd, RECONSTRUCT, "--set", setting) == 2, setting
    run_json = folder / "run" / "run.json"
    values: tuple[object, ...] = (None, -1, "text", [], {})
    for value in values:
        run_json.write_text(json.dumps({**json.loads(run_json.read_text()), "bench": value}))
        one_line(monkeypatch, capfd, "replay run")
