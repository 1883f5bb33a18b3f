"""Recovery of recordings after a crash or power failure."""

from __future__ import annotations

import errno
import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import IO, Any

import numpy as np
import pytest
import zarr
from support.optics import SmallBench
from support.records import RANDOM, SHAPE, make_chain, make_record, noisy_calibration, write

from app.commands.recover import print_recovered
from app.errors import InputError
from app.measurement.calibration import Calibration
from app.recording.reader import Recording
from app.recording.recover import Recovered, frames_in_words, recover


@pytest.fixture(scope="module")
def calibration(small_bench: SmallBench) -> Calibration:
    return noisy_calibration(small_bench)


def test_recovery_removes_a_half_line_and_can_be_repeated(tmp_path: Path, calibration: Calibration) -> None:
    records = make_chain(calibration, 5)
    write(tmp_path / "r", [replace(records[0], made=replace(records[0].made, lost=4)), *records[1:]], finish=False)
    path = tmp_path / "r" / "frames.jsonl"
    whole = path.read_bytes()
    path.write_bytes(whole + whole.splitlines()[-1][:40])
    assert len(Recording(tmp_path / "r")) == 5
    found = recover(tmp_path / "r")
    assert (found.was_complete, found.frames, found.reconstructed) == (False, 5, 5)
    assert (found.lost, found.gaps, found.damage, found.put_aside) == (4, 1, (), "")
    assert path.read_bytes() == whole
    assert zarr.open_array(tmp_path / "r" / "frames.zarr" / "0", mode="r").shape == (5, *SHAPE)
    assert zarr.open_array(tmp_path / "r/frames.zarr/results/0/displacement", mode="r").shape[0] == 5
    everything = {path: path.read_bytes() for path in (tmp_path / "r").rglob("*") if path.is_file()}
    assert recover(tmp_path / "r") == replace(found, was_complete=True)
    assert {path: path.read_bytes() for path in (tmp_path / "r").rglob("*") if path.is_file()} == everything
    assert "recovered" in Recording(tmp_path / "r").ended_early


def test_what_a_killed_program_left_half_written_is_removed_and_named(
    tmp_path: Path, calibration: Calibration, capsys: pytest.CaptureFixture[str]
) -> None:
    write(tmp_path / "r", make_chain(calibration, 2), finish=False)
    before = _everything(tmp_path / "r")
    folder, file = tmp_path / "r/calibrations/.1.partial", tmp_path / "r/.0123456789abcdef.partial.json"
    folder.mkdir()
    (folder / "bench.toml").write_text("half")
    file.write_text("half")
    print_recovered(recover(tmp_path / "r"), Path("r"))
    half_written = "r: half written, and removed: .0123456789abcdef.partial.json, calibrations/.1.partial"
    assert capsys.readouterr().out.splitlines()[1] == half_written
    assert _everything(tmp_path / "r").keys() == before.keys()


def test_recording_without_frames_is_said_to_hold_none(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write(tmp_path / "r", [make_record(0)], finish=False)
    (tmp_path / "r/frames.jsonl").write_bytes(b"")
    print_recovered(recover(tmp_path / "r"), Path("r"))
    assert "r: is complete now: it holds no frame" in capsys.readouterr().out


@pytest.mark.parametrize(
    "change", [{"exposure_s": -1.0}, {"em_gain": -5.0}, {"camera_time_s": 1e300}, {"bias_age_s": -1e300}]
)
def test_impossible_line_is_damage(tmp_path: Path, change: dict[str, float]) -> None:
    write(tmp_path / "r", [make_record(index) for index in range(3)])
    path = tmp_path / "r" / "frames.jsonl"
    lines = path.read_text().splitlines(keepends=True)
    lines[1] = json.dumps({**json.loads(lines[1]), **change}) + "\n"
    path.write_text("".join(lines))
    assert recover(tmp_path / "r").damage == ("frame 1: there is no line that can be read",)
    with pytest.raises(InputError, match="line"):
        Recording(tmp_path / "r").line(1)


@pytest.mark.parametrize(
    "name", ["frames.jsonl", "run.json", "frames.zarr", "frames.zarr/0/zarr.json", "frames.zarr/zarr.json"]
)
def test_nothing_is_changed_through_a_symbolic_link(tmp_path: Path, name: str) -> None:
    write(tmp_path / "r", [make_record(index) for index in range(3)], finish=False)
    link, elsewhere = tmp_path / "r" / name, tmp_path / "elsewhere"
    link.rename(elsewhere)
    link.symlink_to(elsewhere)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    with pytest.raises(InputError, match=f"{name}: is a symbolic link"):
        recover(tmp_path / "r")
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def test_text_behind_the_link_of_the_lines_is_kept(tmp_path: Path) -> None:
    write(tmp_path / "r", [make_record(index) for index in range(3)], finish=False)
    (tmp_path / "important.txt").write_text("important\n")
    (tmp_path / "r" / "frames.jsonl").unlink()
    (tmp_path / "r" / "frames.jsonl").symlink_to("../important.txt")
    with pytest.raises(InputError, match="symbolic link"):
        recover(tmp_path / "r")
    assert (tmp_path / "important.txt").read_text() == "important\n"


def test_recording_without_frames_is_recovered(tmp_path: Path) -> None:
    write(tmp_path / "r", [], finish=False)
    (tmp_path / "r" / "frames.jsonl").unlink()
    assert recover(tmp_path / "r").frames == 0
    assert len(Recording(tmp_path / "r")) == 0


@pytest.mark.parametrize("frames", [None, 5, [], {}, {"recorded": None}, {"recorded": -3}, {"recorded": True}])
def test_complete_recording_without_frame_count_is_counted(tmp_path: Path, frames: object) -> None:
    write(tmp_path / "r", [make_record(index) for index in range(3)])
    path = tmp_path / "r" / "run.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "frames": frames}))
    found = recover(tmp_path / "r")
    assert (found.frames, list(found.whole), found.damage) == (3, [0, 1, 2], ())


def test_unterminated_line_does_not_count(tmp_path: Path) -> None:
    write(tmp_path / "r", [make_record(index) for index in range(3)], finish=False)
    path = tmp_path / "r" / "frames.jsonl"
    whole = path.read_bytes()
    path.write_bytes(whole[:-1])
    assert (recover(tmp_path / "r").frames, path.read_bytes()) == (2, b"".join(whole.splitlines(keepends=True)[:2]))


def test_each_gap_is_counted(tmp_path: Path) -> None:
    write(tmp_path / "r", [make_record(index, lost=lost) for index, lost in enumerate((1, 0, 3))])
    found = recover(tmp_path / "r")
    assert (found.lost, found.gaps) == (4, 2)


def test_complete_recording_may_be_read_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(tmp_path / "r", [make_record(0)])
    really_open = Path.open

    def read_only(path: Path, mode: str = "r", *args: Any, **how: Any) -> IO[Any]:
        if set(mode) & set("wax+"):
            raise PermissionError(errno.EROFS, "Read-only file system", str(path))
        return really_open(path, mode, *args, **how)

    monkeypatch.setattr(Path, "open", read_only)
    assert recover(tmp_path / "r").frames == 1


def test_frame_without_pixels_and_results_is_listed_once(tmp_path: Path, calibration: Calibration) -> None:
    write(tmp_path / "r", make_chain(calibration, 4))
    _lose_pixels(tmp_path / "r", 2)
    for found_live in (tmp_path / "r/frames.zarr/results/0").glob("*/c"):
        shutil.rmtree(found_live / "2", ignore_errors=True)
    for chunk in (tmp_path / "r/frames.zarr/results/0").glob("*/c.2.*"):
        chunk.unlink()
    assert recover(tmp_path / "r").damage == (f"frame 2: {NO_PIXELS}",)


def _cut_short(folder: Path) -> None:
    chunk = folder / "frames.zarr" / "0" / "c" / "3" / "0" / "0"
    chunk.write_bytes(chunk.read_bytes()[:50])


def _spoil(folder: Path) -> None:
    lines = (folder / "frames.jsonl").read_bytes().splitlines(keepends=True)
    (folder / "frames.jsonl").write_bytes(b"".join([*lines[:3], b"\0" * 20 + b"\n", *lines[4:]]))


def _fill_with_brackets(folder: Path) -> None:
    lines = (folder / "frames.jsonl").read_bytes().splitlines(keepends=True)
    (folder / "frames.jsonl").write_bytes(b"".join([*lines[:3], b"[" * 100_000 + b"\n", *lines[4:]]))


def _lose_pixels(folder: Path, *frames: int) -> None:
    for frame in frames:
        (folder / f"frames.zarr/0/c/{frame}/0/0").unlink()


def _everything(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


NO_LINE, NO_PIXELS = "there is no line that can be read", "the pixels are missing, or some of them"


@pytest.mark.parametrize("finish", [False, True])
@pytest.mark.parametrize(
    ("damage", "said", "is_changed"),
    [
        (_cut_short, f"frame 3: {NO_PIXELS}", False),
        (lambda folder: _lose_pixels(folder, 3), f"frame 3: {NO_PIXELS}", False),
        (_spoil, f"frame 3: {NO_LINE}", True),
        (_fill_with_brackets, f"frame 3: {NO_LINE}", True),
    ],
)
def test_damaged_frame_in_the_middle_keeps_the_others(
    tmp_path: Path, calibration: Calibration, damage: Callable[[Path], None], said: str, is_changed: bool, finish: bool
) -> None:
    records = make_chain(calibration, 6)
    write(tmp_path / "r", records, finish=finish)
    damage(tmp_path / "r")
    before = _everything(tmp_path / "r")
    with pytest.raises(InputError):
        Recording(tmp_path / "r").frame(3)
    found = recover(tmp_path / "r")
    assert (found.was_complete, found.frames, list(found.whole)) == (finish, 6, [0, 1, 2, 4, 5])
    assert found.damage == (said,)
    assert "frames 0 to 2 and 4 to 5" in found.readable
    after = _everything(tmp_path / "r")
    assert after.get("frames.damaged.jsonl", after["frames.jsonl"]) == before["frames.jsonl"]
    assert ("frames.damaged.jsonl" in after) == is_changed == bool(found.put_aside)
    recording = Recording(tmp_path / "r")
    assert (len(recording), recording.is_complete) == (6, True)
    for index in found.whole:
        np.testing.assert_array_equal(recording.frame(index).pixels, records[index].made.frame.pixels)
        np.testing.assert_array_equal(recording.displacement(index), records[index].displacement)
    np.testing.assert_array_equal(recording.start(4), records[3].displacement)  # although its line was damaged
    again = recover(tmp_path / "r")
    assert (again.damage, again.was_complete, again.put_aside) == (found.damage, True, "")
    assert _everything(tmp_path / "r") == after
    if finish:
        assert after["run.json"] == before["run.json"]


def test_lines_without_frames_are_put_aside(tmp_path: Path, calibration: Calibration) -> None:
    write(tmp_path / "r", make_chain(calibration, 8), finish=False)
    _lose_pixels(tmp_path / "r", 2, 5, 7)
    shutil.rmtree(tmp_path / "r/frames.zarr/0/c/6")
    text = (tmp_path / "r" / "frames.jsonl").read_bytes()
    found = recover(tmp_path / "r")
    assert (found.frames, list(found.whole), found.damage) == (5, [0, 1, 3, 4], (f"frame 2: {NO_PIXELS}",))
    assert found.put_aside == "the lines after the last whole frame, 3 of them, are in frames.damaged.jsonl"
    kept = (tmp_path / "r" / "frames.jsonl").read_bytes()
    assert kept + (tmp_path / "r" / "frames.damaged.jsonl").read_bytes() == text
    assert len(Recording(tmp_path / "r")) == 5
    assert zarr.open_array(tmp_path / "r" / "frames.zarr" / "0", mode="r").shape == (5, *SHAPE)


def _block_lost(text: bytes) -> bytes:
    """A disk block is zero: three lines lose their newlines, and two of them their places."""
    ends = [at for at, byte in enumerate(text) if byte == ord("\n")]
    return text[: ends[2] + 9] + b"\0" * (ends[5] - ends[2] - 20) + text[ends[5] - 11 :]


def _end_lost(text: bytes) -> bytes:
    return b"".join(text.splitlines(keepends=True)[:6])


def _said_twice(text: bytes) -> bytes:
    lines = text.splitlines(keepends=True)
    lines[3] = lines[3].replace(b'"index": 3', b'"index": 5', 1)
    return b"".join(lines)


@pytest.mark.parametrize(
    ("spoil", "without", "said"),
    [
        (_block_lost, {3, 4, 5}, "frames 3 to 5"),
        (_end_lost, {6, 7, 8, 9}, "frames 6 to 9"),
        (_said_twice, {3, 5}, "frames 3 and 5"),
        (lambda _: b"", set(range(10)), "frames 0 to 9"),
        (lambda text: b"".join(reversed(text.splitlines(keepends=True))), set(), ""),
    ],
)
def test_misplaced_lines_return_to_their_places(
    tmp_path: Path, calibration: Calibration, spoil: Callable[[bytes], bytes], without: set[int], said: str
) -> None:
    records = make_chain(calibration, 10)
    write(tmp_path / "r", records)
    lines = [Recording(tmp_path / "r").line(index) for index in range(10)]
    path = tmp_path / "r" / "frames.jsonl"
    spoilt = spoil(path.read_bytes())
    path.write_bytes(spoilt)
    found = recover(tmp_path / "r")
    assert found.was_complete
    assert found.damage == ((f"{said}: {NO_LINE}",) if said else ())
    assert set(found.whole) == set(range(10)) - without
    assert "frames.damaged.jsonl" in found.put_aside
    assert path.with_name("frames.damaged.jsonl").read_bytes() == spoilt
    recording = Recording(tmp_path / "r")
    assert len(recording) == 10
    for index in range(10):
        if index in without:
            with pytest.raises(InputError, match=f"line {index + 1} is damaged; svwfs recover lists"):
                recording.line(index)
        else:
            assert recording.line(index) == lines[index]
            np.testing.assert_array_equal(recording.pixels(index), records[index].made.frame.pixels)
    for text in path.read_text().splitlines():
        json.loads(text)  # standard JSON
    before = _everything(tmp_path / "r")
    assert recover(tmp_path / "r") == replace(found, put_aside="")
    assert _everything(tmp_path / "r") == before


def test_bytes_after_a_complete_recording_stay(tmp_path: Path) -> None:
    write(tmp_path / "r", [make_record(index) for index in range(4)])
    path = tmp_path / "r" / "frames.jsonl"
    path.write_bytes(path.read_bytes() + path.read_bytes().splitlines(keepends=True)[0] + b"and half a line")
    before = _everything(tmp_path / "r")
    found = recover(tmp_path / "r")
    assert (found.was_complete, found.frames, found.put_aside) == (True, 4, "")
    assert _everything(tmp_path / "r") == before


def test_put_aside_lines_are_never_overwritten(tmp_path: Path) -> None:
    write(tmp_path / "r", [make_record(index) for index in range(6)])
    path = tmp_path / "r" / "frames.jsonl"
    spoilt = []
    for line in (1, 4, 2):
        lines = path.read_bytes().splitlines(keepends=True)
        spoilt.append(b"".join([*lines[:line], b"?\n", *lines[line + 1 :]]))
        path.write_bytes(spoilt[-1])
        recover(tmp_path / "r")
    names = ("frames.damaged.jsonl", "frames.damaged-2.jsonl", "frames.damaged-3.jsonl")
    assert [(tmp_path / "r" / name).read_bytes() for name in names] == spoilt
    assert list(recover(tmp_path / "r").whole) == [0, 3, 5]


def test_missing_results_calibrations_and_biases_are_listed(tmp_path: Path, calibration: Calibration) -> None:
    bias = RANDOM.normal(size=(7, 9, 3, 2))
    passed_over = make_record(2, calibration, displacement=None, coefficients=None, problem="skipped")
    records = [*make_chain(calibration, 2), passed_over, make_record(3, calibration, bias=bias, bias_age_s=0.1)]
    records[0] = replace(records[0], start=RANDOM.normal(size=(7, 9, 3, 2)))
    write(tmp_path / "r", [*records, make_record(4)])
    assert recover(tmp_path / "r").damage == ()
    results = tmp_path / "r" / "frames.zarr" / "results" / "0"
    (results / "coefficients/c.1.0.0").unlink()
    (results / "displacement/c.3.0.0.0.0").write_bytes(b"half")
    (tmp_path / "r/calibrations/0/dark.npz").write_bytes(b"PK")
    (tmp_path / "r/biases/0.npy").unlink()
    (tmp_path / "r/start.npy").unlink()
    before = _everything(tmp_path / "r")
    found = recover(tmp_path / "r")
    assert (list(found.whole), found.readable, found.put_aside) == (list(range(5)), "", "")
    first, dark, of_bias, start = found.damage
    assert first == "frames 1 and 3: what was found live is missing; svwfs replay finds it again"
    assert "calibrations/0/dark.npz: cannot be read" in dark
    assert "biases/0.npy: no such file" in of_bias
    assert "start.npy: no such file" in start
    assert _everything(tmp_path / "r") == before


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
    _lose_pixels(tmp_path / "r", 0, 3, 4, 5, 6, 7)
    print_recovered(recover(tmp_path / "r"), Path("r"))
    assert capsys.readouterr().out.splitlines()[1:] == [f"r: frames 0 to 8: {NO_PIXELS}", "r: no frame is whole"]


@pytest.mark.parametrize(
    ("frames", "words"),
    [
        ([4], "frame 4"),
        ([0, 1, 2], "frames 0 to 2"),
        ([0, 2], "frames 0 and 2"),
        ([0, 2, 3, 9, 10], "frames 0, 2 to 3 and 9 to 10"),
        (range(0, 40, 2), f"frames {', '.join(str(frame) for frame in range(0, 38, 2))} and 38"),
        (range(0, 100, 2), f"frames {', '.join(str(frame) for frame in range(0, 40, 2))} and 30 more"),
    ],
)
def test_frame_numbers_are_joined_in_words(frames: Sequence[int], words: str) -> None:
    assert frames_in_words(frames) == words


def test_single_frame_and_gap_are_named_as_such() -> None:
    found = Recovered(was_complete=True, frames=1, reconstructed=1, lost=3, gaps=1)
    assert found.summary == "1 frame, 1 of them reconstructed live; the camera lost 3 in 1 gap"
