"""Messages for missing or damaged parts of a recording."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from support.optics import SmallBench
from support.records import RANDOM, make_record, noisy_calibration, write

from app.errors import InputError
from app.measurement.calibration import Calibration
from app.recording.reader import Recording
from app.recording.recover import recover


@pytest.fixture(scope="module")
def calibration(small_bench: SmallBench) -> Calibration:
    return noisy_calibration(small_bench)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda folder: None, "no such folder"),
        (lambda folder: folder.write_text("x"), "not a folder"),
        (lambda folder: folder.mkdir(), "holds no recording"),
        (lambda folder: (folder.mkdir(), (folder / "run.json").write_text("{")), "cannot be read"),
        (lambda folder: (folder.mkdir(), (folder / "run.json").write_bytes(b"\xff\xfe")), "cannot be read"),
        (lambda folder: (folder.mkdir(), (folder / "run.json").write_text('{"command": "live"}')), "not the file of"),
        (lambda folder: (folder.mkdir(), (folder / "run.json").write_text("[]")), "not the file of"),
    ],
)
def test_folder_without_a_recording_is_reported(tmp_path: Path, make: Callable[[Path], object], said: str) -> None:
    make(tmp_path / "r")
    for use in (Recording, recover):
        with pytest.raises(InputError, match=said):
            use(tmp_path / "r")


def retyped(metadata: Path) -> None:
    """Give counts a sign."""
    metadata.write_text(metadata.read_text().replace('"uint16"', '"int16"'))


@pytest.mark.parametrize(
    ("damage", "use", "said"),
    [
        (lambda r: (r / "calibrations/0/reference.npz").unlink(), lambda r: r.calibration(0), "reference.npz"),
        (lambda r: (r / "calibrations/0/dark.npz").write_bytes(b"PK"), lambda r: r.calibration(0), "dark.npz"),
        (lambda r: (r / "calibrations/0/camera.json").write_text("{}"), lambda r: r.calibration(0), "full_scale"),
        (lambda r: (r / "calibrations/0/bench.toml").write_text("[sensor]"), lambda r: r.calibration(0), "bench.toml"),
        (lambda r: (r / "biases/0.npy").write_bytes(b"x"), lambda r: r.bias(0), "0.npy"),
        (lambda r: None, lambda r: r.calibration(7), "7"),
        (lambda r: None, lambda r: r.line(2), "has no frame 2; it has 2"),
        (lambda r: None, lambda r: r.line(-1), "has no frame -1"),
        (lambda r: (r / "frames.zarr/0/zarr.json").write_text("{}"), lambda r: r.pixels(0), "not an array of"),
        (lambda r: retyped(r / "frames.zarr/0/zarr.json"), lambda r: r.pixels(0), "not an array of a recording"),
        (lambda r: (r / "frames.zarr/0/zarr.json").unlink(), lambda r: r.pixels(0), "pixels of frame 0 are missing"),
    ],
)
def test_missing_or_damaged_file_is_named(
    tmp_path: Path,
    calibration: Calibration,
    damage: Callable[[Path], object],
    use: Callable[[Recording], object],
    said: str,
) -> None:
    bias = RANDOM.normal(size=(7, 9, 3, 2))
    write(tmp_path / "r", [make_record(0, calibration, bias=bias), make_record(1, calibration, bias=bias)])
    damage(tmp_path / "r")
    with pytest.raises(InputError, match=said):
        use(Recording(tmp_path / "r"))


def test_misplaced_line_is_detected(tmp_path: Path) -> None:
    write(tmp_path / "r", [make_record(0), make_record(1)])
    path = tmp_path / "r" / "frames.jsonl"
    path.write_text("".join(reversed(path.read_text().splitlines(keepends=True))))
    with pytest.raises(InputError, match="line 1 is of frame 1"):
        Recording(tmp_path / "r").line(0)
