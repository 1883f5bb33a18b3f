"""Messages for missing or damaged parts of a recording."""

from __future__ import annotations

import binascii
import errno
import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.optics import SmallBench
from support.records import RANDOM, make_record, noisy_calibration, write

import svwfs
from app.errors import InputError
from app.measurement.calibration import Calibration
from app.recording.frame_array import DamagedFrame
from app.recording.reader import Recording
from app.recording.recover import recover

PIXELS_1 = "frames.zarr/0/c/1/0/0"


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
        (lambda r: np.save(r / "start.npy", np.zeros(3)), lambda r: r.start(0), "frame 0 starts from are damaged"),
        (lambda r: np.save(r / "start.npy", np.zeros((2, 9, 3, 2))), lambda r: r.start(0), "starts from are damaged"),
        (
            lambda r: np.save(r / "start.npy", np.full((7, 9, 3, 2), 1e9)),
            lambda r: r.start(0),
            "starts from are damaged",
        ),
        (lambda r: (r / "start.npy").unlink(), lambda r: r.start(0), r"no such file; leave frame 0 out \(--frames\)"),
        (
            lambda r: (r / PIXELS_1).write_bytes(b"x"),
            lambda r: r.pixels(1),
            "1 bytes instead of .*; svwfs recover lists",
        ),
        (lambda r: (r / PIXELS_1).unlink(), lambda r: r.pixels(1), "missing; svwfs recover lists the readable frames"),
        (lambda r: None, lambda r: r.calibration(7), "7"),
        (lambda r: None, lambda r: r.line(2), "has no frame 2; it has 2"),
        (lambda r: None, lambda r: r.line(-1), "has no frame -1"),
        (
            lambda r: (r / "frames.zarr/0/zarr.json").write_text("{}"),
            lambda r: r.pixels(0),
            "svwfs recover makes it again",
        ),
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
    first = replace(make_record(0, calibration, bias=bias), start=np.zeros((7, 9, 3, 2)))
    write(tmp_path / "r", [first, make_record(1, calibration, bias=bias)])
    damage(tmp_path / "r")
    with pytest.raises(InputError, match=said):
        use(Recording(tmp_path / "r"))


@pytest.mark.parametrize(
    "use",
    [Recording.refresh, lambda r: r.line(0), lambda r: r.pixels(0), lambda r: r.frame_shape, lambda r: r.stored_frames],
)
def test_lost_disk_is_unusable_input(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, use: Callable[[Recording], object]
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise OSError(errno.ENOTCONN, "Transport endpoint is not connected")

    write(tmp_path / "r", [make_record(0)])
    recording = Recording(tmp_path / "r")
    with monkeypatch.context() as lost:
        for name in ("stat", "open", "iterdir"):
            lost.setattr(Path, name, fail)
        with pytest.raises(InputError, match=r"r/.*: cannot be read: Transport endpoint is not connected"):
            use(recording)


def test_misplaced_line_is_detected(tmp_path: Path) -> None:
    write(tmp_path / "r", [make_record(0), make_record(1)])
    path = tmp_path / "r" / "frames.jsonl"
    path.write_text("".join(reversed(path.read_text().splitlines(keepends=True))))
    with pytest.raises(InputError, match="line 1 is of frame 1"):
        Recording(tmp_path / "r").line(0)


def flip(folder: Path, index: int) -> None:
    """Change one bit of a frame's pixels."""
    chunk = folder / f"frames.zarr/0/c/{index}/0/0"
    held = bytearray(chunk.read_bytes())
    held[len(held) // 2] ^= 4
    chunk.write_bytes(held)


def test_flipped_bit_is_named_by_every_reader(tmp_path: Path, calibration: Calibration) -> None:
    write(tmp_path / "r", [make_record(index, calibration) for index in range(3)])
    recording = Recording(tmp_path / "r")
    flip(tmp_path / "r", 1)
    said = r"r: the pixels of frame 1 are not those that were recorded; svwfs recover lists the readable frames$"
    opened = svwfs.open_recording(tmp_path / "r")
    readers: tuple[Callable[[int], object], ...] = (
        recording.pixels,
        recording.frame,
        lambda index: opened.frames[index].values,
    )
    for read in readers:
        with pytest.raises(DamagedFrame, match=said):
            read(1)
        read(2)
    found = recover(tmp_path / "r")
    assert found.damage == ("frame 1: the pixels are not those that were recorded",)
    assert found.whole == [0, 2]
    flip(tmp_path / "r", 1)
    assert recover(tmp_path / "r").damage == ()


def test_checksum_is_that_of_the_chunk(tmp_path: Path, calibration: Calibration) -> None:
    write(tmp_path / "r", [make_record(0, calibration)])
    line = json.loads((tmp_path / "r" / "frames.jsonl").read_text())
    assert int(line["crc32"], 16) == binascii.crc32((tmp_path / "r/frames.zarr/0/c/0/0/0").read_bytes())


def test_recording_without_checksums_opens(tmp_path: Path, calibration: Calibration) -> None:
    write(tmp_path / "r", [make_record(0, calibration)])
    path = tmp_path / "r" / "frames.jsonl"
    path.write_text(re.sub(r', "crc32": "\w+"', "", path.read_text()))
    flip(tmp_path / "r", 0)
    assert Recording(tmp_path / "r").line(0).crc32 is None
    assert Recording(tmp_path / "r").pixels(0).size
    assert recover(tmp_path / "r").damage == ()
