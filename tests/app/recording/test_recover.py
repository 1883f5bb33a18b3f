"""Recordings after a crash, a power failure, a full disk or an incomplete copy: errors of readers, and recovery."""

from __future__ import annotations

import binascii
import errno
import json
import math
import os
import re
import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import IO, Any

import numpy as np
import pytest
import zarr
from support.command_line import run
from support.optics import SmallBench
from support.records import RANDOM, SHAPE, frame_file, make_record, make_records, noisy_calibration, write
from support.windows import open_files_stay

import svwfs
from app.commands.recover import print_recovered
from app.errors import InputError
from app.measurement.calibration import Calibration
from app.recording.frame_array import DamagedFrame
from app.recording.reader import Recording
from app.recording.recover import Recovered, frames_in_words, recover

NO_LINE = "there is no line that can be read"
NO_PIXELS = "the pixels are missing, cut short, or not those that were recorded"


@pytest.fixture(scope="module")
def calibration(small_bench: SmallBench) -> Calibration:
    return noisy_calibration(small_bench)


def _lose_pixels(folder: Path, *frames: int) -> None:
    for frame in frames:
        frame_file(folder, frame).unlink()


def _cut_short(folder: Path, frame: int) -> None:
    frame_file(folder, frame).write_bytes(frame_file(folder, frame).read_bytes()[:50])


def _flip(folder: Path, frame: int) -> None:
    """Change one bit of a frame's pixels."""
    held = bytearray(frame_file(folder, frame).read_bytes())
    held[len(held) // 2] ^= 4
    frame_file(folder, frame).write_bytes(held)


def _spoil_line(folder: Path, frame: int) -> None:
    lines = (folder / "frames.jsonl").read_bytes().splitlines(keepends=True)
    lines[frame] = b"\0" * 20 + b"\n"
    (folder / "frames.jsonl").write_bytes(b"".join(lines))


def _lose_line(folder: Path, frame: int) -> None:
    lines = (folder / "frames.jsonl").read_bytes().splitlines(keepends=True)
    (folder / "frames.jsonl").write_bytes(b"".join([*lines[:frame], *lines[frame + 1 :]]))


def _everything(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_recovery_removes_a_half_line_and_can_be_repeated(tmp_path: Path, calibration: Calibration) -> None:
    records = make_records(calibration, 5)
    records[0], records[3] = (replace(each, made=replace(each.made, lost=2)) for each in (records[0], records[3]))
    write(tmp_path / "r", records, finish=False)
    path = tmp_path / "r" / "frames.jsonl"
    whole = path.read_bytes()
    path.write_bytes(whole + whole.splitlines()[-1][:40])
    assert len(Recording(tmp_path / "r")) == 5
    found = recover(tmp_path / "r")
    assert (found.was_complete, found.frames, found.reconstructed) == (False, 5, 5)
    assert (found.lost, found.gaps, found.damage, found.put_aside) == (4, 2, (), "")
    assert path.read_bytes() == whole
    assert zarr.open_array(tmp_path / "r" / "frames.zarr" / "0", mode="r").shape == (5, *SHAPE)
    assert zarr.open_array(tmp_path / "r/frames.zarr/results/0/displacement", mode="r").shape[0] == 5
    before = _everything(tmp_path / "r")
    assert recover(tmp_path / "r") == replace(found, was_complete=True)
    assert _everything(tmp_path / "r") == before
    assert "recovered" in Recording(tmp_path / "r").ended_early


def test_files_that_a_killed_program_left_half_written_are_removed_and_named(
    tmp_path: Path, calibration: Calibration, capsys: pytest.CaptureFixture[str]
) -> None:
    write(tmp_path / "r", make_records(calibration, 2), finish=False)
    before = _everything(tmp_path / "r")
    folder, file = tmp_path / "r/calibrations/.1.partial", tmp_path / "r/.0123456789abcdef.partial.json"
    folder.mkdir()
    (folder / "bench.toml").write_text("half")
    file.write_text("half")
    print_recovered(recover(tmp_path / "r"), Path("r"))
    half_written = f"r: half written, and removed: .0123456789abcdef.partial.json, {Path('calibrations/.1.partial')}"
    assert capsys.readouterr().out.splitlines()[1] == half_written
    assert _everything(tmp_path / "r").keys() == before.keys()


@pytest.mark.parametrize("has_lines", [False, True])
def test_recording_without_frames_is_recovered(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], has_lines: bool
) -> None:
    write(tmp_path / "r", [make_record(0)] * has_lines, finish=False)
    (tmp_path / "r/frames.jsonl").write_bytes(b"") if has_lines else (tmp_path / "r/frames.jsonl").unlink()
    print_recovered(recover(tmp_path / "r"), Path("r"))
    assert "r: is complete now: it holds no frame" in capsys.readouterr().out
    assert len(Recording(tmp_path / "r")) == 0


def test_complete_recording_may_be_read_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(tmp_path / "r", [make_record(0)])
    really_open = Path.open

    def read_only(path: Path, mode: str = "r", *args: Any, **how: Any) -> IO[Any]:
        if set(mode) & set("wax+"):
            raise PermissionError(errno.EROFS, "Read-only file system", str(path))
        return really_open(path, mode, *args, **how)

    monkeypatch.setattr(Path, "open", read_only)
    assert recover(tmp_path / "r").frames == 1


@pytest.mark.parametrize("finish", [False, True])
@pytest.mark.parametrize(
    ("damage", "said", "is_changed"),
    [
        (_cut_short, NO_PIXELS, False),
        (_lose_pixels, NO_PIXELS, False),
        (_flip, NO_PIXELS, False),
        (_spoil_line, NO_LINE, True),
        (_lose_line, NO_LINE, True),
    ],
)
def test_damaged_frame_in_the_middle_keeps_the_others(
    tmp_path: Path,
    calibration: Calibration,
    damage: Callable[[Path, int], None],
    said: str,
    is_changed: bool,
    finish: bool,
) -> None:
    records = make_records(calibration, 6)
    write(tmp_path / "r", records, finish=finish)
    damage(tmp_path / "r", 3)
    before = _everything(tmp_path / "r")
    with pytest.raises(DamagedFrame):
        Recording(tmp_path / "r").frame(3)
    found = recover(tmp_path / "r")
    assert (found.was_complete, found.frames, list(found.whole)) == (finish, 6, [0, 1, 2, 4, 5])
    assert found.damage == (f"frame 3: {said}",)
    assert "frames 0 to 2 and 4 to 5" in found.readable
    after = _everything(tmp_path / "r")
    assert after.get("frames.damaged.jsonl", after["frames.jsonl"]) == before["frames.jsonl"]
    assert ("frames.damaged.jsonl" in after) == is_changed == bool(found.put_aside)
    recording = Recording(tmp_path / "r")
    assert (len(recording), recording.is_complete) == (6, True)
    for index in found.whole:
        np.testing.assert_array_equal(recording.frame(index).pixels, records[index].made.frame.pixels)
        np.testing.assert_array_equal(recording.displacement(index), records[index].displacement)
    again = recover(tmp_path / "r")
    assert (again.damage, again.was_complete, again.put_aside) == (found.damage, True, "")
    assert _everything(tmp_path / "r") == after


def test_lines_after_the_last_whole_frame_are_put_aside(tmp_path: Path, calibration: Calibration) -> None:
    write(tmp_path / "r", make_records(calibration, 8), finish=False)
    _lose_pixels(tmp_path / "r", 2, 5, 7)
    shutil.rmtree(tmp_path / "r/frames.zarr/0/c/6")
    text = (tmp_path / "r" / "frames.jsonl").read_bytes()
    found = recover(tmp_path / "r")
    assert (found.frames, list(found.whole), found.damage) == (5, [0, 1, 3, 4], (f"frame 2: {NO_PIXELS}",))
    assert (tmp_path / "r" / "frames.damaged.jsonl").read_bytes() == text
    assert text.startswith((tmp_path / "r" / "frames.jsonl").read_bytes())
    assert len(Recording(tmp_path / "r")) == 5
    assert zarr.open_array(tmp_path / "r" / "frames.zarr" / "0", mode="r").shape == (5, *SHAPE)


@pytest.mark.parametrize("lost", [1, 150, 1000])
def test_power_failure_loses_the_end_of_a_chunk_only(tmp_path: Path, calibration: Calibration, lost: int) -> None:
    """The last of two chunks, with frames 16 to 19, lacks some bytes."""
    records = make_records(calibration, 20)
    write(tmp_path / "r", records, finish=False)
    chunk, size = tmp_path / "r/frames.zarr/0/c/1/0/0", 2 * math.prod(SHAPE)
    os.truncate(chunk, max(4 * size - lost, 0))
    kept = 16 + max(4 * size - lost, 0) // size
    found = recover(tmp_path / "r")
    assert (found.whole, found.damage) == (list(range(kept)), ())
    group = zarr.open_group(tmp_path / "r" / "frames.zarr", mode="r")
    recording, pixels = Recording(tmp_path / "r"), np.asarray(group["0"])
    displacements = np.asarray(group["results/0/displacement"])
    assert len(pixels) == len(displacements) == kept
    for index in range(kept):
        np.testing.assert_array_equal(pixels[index], records[index].made.frame.pixels)
        np.testing.assert_array_equal(recording.pixels(index), records[index].made.frame.pixels)
        np.testing.assert_array_equal(displacements[index], records[index].displacement)


def test_lines_of_a_copy_that_was_cut_short_are_listed(tmp_path: Path, calibration: Calibration) -> None:
    write(tmp_path / "r", make_records(calibration, 10))
    path = tmp_path / "r" / "frames.jsonl"
    path.write_bytes(path.read_bytes()[:-1000])
    kept = len(Recording(tmp_path / "r"))
    assert 0 < kept < 10
    found = recover(tmp_path / "r")
    assert (found.was_complete, found.frames, found.whole) == (True, 10, list(range(kept)))
    assert found.damage[0].endswith(NO_LINE)
    with pytest.raises(InputError, match="line 10 is damaged; svwfs recover lists"):
        Recording(tmp_path / "r").line(9)
    for text in path.read_text().splitlines():
        json.loads(text)  # standard JSON


def test_lines_are_replaced_while_nothing_has_them_open(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Windows replaces no open file."""
    write(tmp_path / "r", [make_record(index) for index in range(3)], finish=False)
    lines = (tmp_path / "r" / "frames.jsonl").read_bytes()
    (tmp_path / "r" / "frames.jsonl").write_bytes(lines + b"{")
    open_files_stay(monkeypatch)
    assert recover(tmp_path / "r").frames == 3
    assert (tmp_path / "r" / "frames.jsonl").read_bytes() == lines


def test_put_aside_lines_are_never_overwritten(tmp_path: Path) -> None:
    write(tmp_path / "r", [make_record(index) for index in range(6)])
    spoilt = []
    for line in (1, 4, 2):
        _spoil_line(tmp_path / "r", line)
        spoilt.append((tmp_path / "r" / "frames.jsonl").read_bytes())
        recover(tmp_path / "r")
    names = ("frames.damaged.jsonl", "frames.damaged-2.jsonl", "frames.damaged-3.jsonl")
    assert [(tmp_path / "r" / name).read_bytes() for name in names] == spoilt
    assert list(recover(tmp_path / "r").whole) == [0, 3, 5]


def test_missing_calibrations_and_biases_are_listed(tmp_path: Path, calibration: Calibration) -> None:
    bias = RANDOM.normal(size=(7, 9, 3, 2))
    write(tmp_path / "r", [make_record(0, calibration, bias=bias, bias_age_s=0.1), make_record(1)])
    assert recover(tmp_path / "r").damage == ()
    (tmp_path / "r/calibrations/0/dark.npz").write_bytes(b"PK")
    (tmp_path / "r/biases/0.npy").unlink()
    found = recover(tmp_path / "r")
    assert (list(found.whole), found.readable, found.has_calibration) == ([0, 1], "", False)
    dark, of_bias = found.damage
    assert f"{Path('calibrations/0/dark.npz')}: cannot be read" in dark
    assert f"{Path('biases/0.npy')}: no such file" in of_bias


def test_recover_suggests_a_usable_selection(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write(tmp_path / "r", [make_record(index) for index in range(9)])
    _lose_pixels(tmp_path / "r", 1, 2, 8)
    print_recovered(recover(tmp_path / "r"), Path("r"))
    assert capsys.readouterr().out.splitlines() == [
        "r: was complete, but damaged: 9 frames, 0 of them reconstructed live; no gaps",
        f"r: frames 1 to 2 and 8: {NO_PIXELS}",
        "r: whole: frames 0 and 3 to 7; replay, batch, export and report take some with --frames, as 3:8",
    ]
    recording = Recording(tmp_path / "r")
    for index in recording.select("3:8"):
        recording.frame(index)


def test_exit_status_is_1_if_nothing_can_be_reconstructed(
    tmp_path: Path, calibration: Calibration, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "r"
    write(folder, make_records(calibration, 2))
    assert run(monkeypatch, "recover", folder) == 0
    (folder / "calibrations/0/reference.npz").write_bytes(b"")
    capsys.readouterr()
    assert run(monkeypatch, "recover", folder) == 1
    said = capsys.readouterr()
    assert said.err.endswith("no frame can be reconstructed, because no calibration can be read\n")
    assert "reference.npz" in said.out
    _lose_pixels(folder, 0, 1)
    assert run(monkeypatch, "recover", folder) == 1
    assert capsys.readouterr().err == f"svwfs: {folder}: no frame is whole\n"


@pytest.mark.parametrize(
    ("frames", "words"),
    [
        ([4], "frame 4"),
        ([0, 2, 3, 9, 10], "frames 0, 2 to 3 and 9 to 10"),
        (range(0, 100, 2), f"frames {', '.join(str(frame) for frame in range(0, 40, 2))} and 30 more"),
    ],
)
def test_frame_numbers_are_joined_in_words(frames: Sequence[int], words: str) -> None:
    assert frames_in_words(frames) == words


def test_single_frame_and_gap_are_named_as_such() -> None:
    found = Recovered(was_complete=True, frames=1, reconstructed=1, lost=3, gaps=1)
    assert found.summary == "1 frame, 1 of them reconstructed live; the camera lost 3 in 1 gap"


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda folder: None, "no such folder"),
        (lambda folder: folder.write_text("x"), "not a folder"),
        (lambda folder: folder.mkdir(), "holds no recording"),
        (lambda folder: (folder.mkdir(), (folder / "run.json").write_text("{")), "is damaged"),
        (lambda folder: (folder.mkdir(), (folder / "run.json").write_bytes(b"\xff\xfe")), "is damaged"),
        (lambda folder: (folder.mkdir(), (folder / "run.json").write_text('{"command": "live"}')), "not the file of"),
    ],
)
def test_folder_without_a_recording_is_reported(tmp_path: Path, make: Callable[[Path], object], said: str) -> None:
    make(tmp_path / "r")
    for use in (Recording, recover):
        with pytest.raises(InputError, match=said):
            use(tmp_path / "r")


def _flip_reference(folder: Path) -> None:
    path = folder / "calibrations/0/reference.npz"
    held = bytearray(path.read_bytes())
    held[len(held) // 2] ^= 4
    path.write_bytes(held)


@pytest.mark.parametrize(
    ("damage", "use", "said"),
    [
        (lambda r: (r / "calibrations/0/reference.npz").unlink(), lambda r: r.calibration(0), "reference.npz"),
        (_flip_reference, lambda r: r.calibration(0), "reference.npz: cannot be read: Bad CRC-32"),
        (lambda r: (r / "calibrations/0/dark.npz").write_bytes(b"PK"), lambda r: r.calibration(0), "dark.npz"),
        (lambda r: (r / "calibrations/0/camera.json").write_text("{}"), lambda r: r.calibration(0), "full_scale"),
        (lambda r: (r / "calibrations/0/bench.toml").write_text("[sensor]"), lambda r: r.calibration(0), "bench.toml"),
        (lambda r: (r / "biases/0.npy").write_bytes(b"x"), lambda r: r.bias(0), "0.npy"),
        (lambda r: frame_file(r, 1).write_bytes(b"x"), lambda r: r.pixels(1), "1 bytes instead of .*; svwfs recover"),
        (lambda r: _lose_pixels(r, 1), lambda r: r.pixels(1), "missing; svwfs recover lists the readable frames"),
        (lambda r: None, lambda r: r.calibration(7), "7"),
        (lambda r: None, lambda r: r.line(2), "has no frame 2; it has 2"),
        (lambda r: None, lambda r: r.line(-1), "has no frame -1"),
        (lambda r: (r / "frames.zarr/0/zarr.json").write_text("{"), lambda r: r.pixels(0), "zarr.json: is damaged"),
        (lambda r: (r / "frames.zarr/0/zarr.json").unlink(), lambda r: r.pixels(0), "pixels of frame 0 are missing"),
        (lambda r: _lose_line(r, 0), lambda r: r.line(0), "line 1 is of frame 1"),
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
    write(tmp_path / "r", [make_record(index, calibration, bias=bias) for index in range(2)])
    damage(tmp_path / "r")
    with pytest.raises(InputError, match=said):
        use(Recording(tmp_path / "r"))


@pytest.mark.parametrize("use", [Recording.refresh, lambda r: r.line(0), lambda r: r.pixels(0)])
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
        with pytest.raises(InputError, match=r"r[/\\].*: cannot be read: Transport endpoint is not connected"):
            use(recording)


def test_flipped_bit_is_named_by_every_reader(tmp_path: Path, calibration: Calibration) -> None:
    write(tmp_path / "r", make_records(calibration, 3))
    recording, opened = Recording(tmp_path / "r"), svwfs.open_recording(tmp_path / "r")
    _flip(tmp_path / "r", 1)
    said = r"r: the pixels of frame 1 are not those that were recorded; svwfs recover lists the readable frames$"
    readers: tuple[Callable[[int], object], ...] = (
        recording.pixels,
        recording.frame,
        lambda index: opened.frames[index].values,
    )
    for read in readers:
        with pytest.raises(DamagedFrame, match=said):
            read(1)
        read(2)


def test_checksum_is_that_of_the_frame_in_its_chunk(tmp_path: Path, calibration: Calibration) -> None:
    write(tmp_path / "r", make_records(calibration, 2))
    lines = (tmp_path / "r" / "frames.jsonl").read_text().splitlines()
    chunk, size = (tmp_path / "r/frames.zarr/0/c/0/0/0").read_bytes(), 2 * math.prod(SHAPE)
    for index, line in enumerate(lines):
        assert int(json.loads(line)["crc32"], 16) == binascii.crc32(chunk[index * size : (index + 1) * size])


def test_recording_without_checksums_opens(tmp_path: Path, calibration: Calibration) -> None:
    write(tmp_path / "r", [make_record(0, calibration)])
    path = tmp_path / "r" / "frames.jsonl"
    path.write_text(re.sub(r', "crc32": "\w+"', "", path.read_text()))
    _flip(tmp_path / "r", 0)
    assert Recording(tmp_path / "r").line(0).crc32 is None
    assert Recording(tmp_path / "r").pixels(0).size
    assert recover(tmp_path / "r").damage == ()
