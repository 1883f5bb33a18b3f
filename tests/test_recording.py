"""A recording's folder: what is written can be read, by Zarr's own library, too, and whatever ends it, it stays so."""

from __future__ import annotations

import errno
import json
import math
import os
import threading
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import zarr
from optics import FIELD, SmallBench

from app.calibration import Calibration
from app.config import Bench, write_bench
from app.errors import InputError
from app.measurement import Counts, LightState, Measurement
from app.recording import background, frame_array, recorder
from app.recording.background import BackgroundRecording, RecordingState
from app.recording.frame_array import FrameArray
from app.recording.reader import Recording
from app.recording.record import Record
from app.recording.recorder import Recorder
from app.recording.recover import recover
from app.recording.run_writer import RunWriter
from app.routines import Average
from app.timing import Timings
from drivers.interface import Frame
from reconstruction.geometry import Floats

SHAPE = (6, 10)
RANDOM = np.random.default_rng(7)
FACTS = {"command": "live", "bench": "", "devices": {"camera": {"name": "none"}}}


def make_frame(index: int, shape: tuple[int, int] = SHAPE) -> Frame:
    pixels = RANDOM.integers(0, 65536, shape).astype(np.uint16)
    return Frame(pixels, index, 100 + index / 70, 200 + index / 70, 0.0139, 8.0)


def make_record(index: int, calibration: Calibration | None = None, **changes: Any) -> Record:
    """A record of noise; with a calibration it has results."""
    has = calibration is not None
    record = Record(
        frame=make_frame(index),
        lost=0,
        light=LightState(is_on=True, current_a=0.35),
        problem="" if has else "no reference yet",
        calibration=calibration,
        bias=None,
        bias_age_s=None,
        start=None,
        displacement=RANDOM.normal(size=(7, 9, 3, 2)) if has else None,
        coefficients=RANDOM.normal(size=(15, 3)) if has else None,
        views=RANDOM.normal(size=(3, 3, 7, 9)) if has else None,
        valid=63 if has else None,
    )
    return replace(record, **changes)


def make_chain(calibration: Calibration, count: int) -> list[Record]:
    """Records of which each was registered from the one before."""
    records: list[Record] = []
    for index in range(count):
        records.append(make_record(index, calibration, start=records[-1].displacement if records else None))
    return records


def write(folder: Path, records: list[Record], *, finish: bool = True) -> RunWriter:
    writer = RunWriter(folder, FACTS)
    for record in records:
        writer.write(record)
    if finish:
        writer.finish("", acquired=len(records), facts={})
    writer.close()
    return writer


def wait(recording: BackgroundRecording | Recorder, stages: set[str]) -> RecordingState:
    deadline_s = time.monotonic() + 60
    while (state := recording.state) is None or state.stage not in stages:
        assert time.monotonic() < deadline_s
        time.sleep(0.005)
    return state


@pytest.fixture(scope="module")
def calibration(small_bench: SmallBench) -> Calibration:
    """A calibration with noise in its averages, so that every bit of them counts."""
    random = np.random.default_rng(1)

    def average(mean: Floats, frames: int) -> Average:
        noise = random.normal(0, 3, (2, *mean.shape))
        variance = 400 + mean + noise[1]
        return Average((mean + noise[0]).astype("f4"), variance.astype("f4"), frames, 0.02, 8.0, "em")

    bench = Bench(sensor=small_bench.sensor, field=FIELD)
    light = np.asarray(small_bench.reference * 3000 / small_bench.reference.max(), np.float64)
    dark = average(np.full(light.shape, 500.0), 9)
    return Calibration(bench, dark, average(light + 500, 7), small_bench.lattice, 65535.0)


def test_what_is_written_can_be_read(tmp_path: Path, calibration: Calibration) -> None:
    other, bias = replace(calibration), RANDOM.normal(size=(7, 9, 3, 2))
    before = RANDOM.normal(size=(7, 9, 3, 2))
    first = make_record(50, calibration, start=before, lost=3)
    failed = make_record(51, calibration, displacement=None, coefficients=None, problem="too dark")
    second = make_record(52, calibration, start=first.displacement, bias=bias, bias_age_s=0.2)
    third = make_record(60, other, displacement=RANDOM.normal(size=(7, 9, 6, 2)), coefficients=None)
    records = [first, failed, second, third, make_record(61, light=None)]
    write(tmp_path / "r", records)

    recording = Recording(tmp_path / "r")
    assert (len(recording), recording.is_complete, recording.ended_early) == (5, True, "")
    assert recording.run["frames"] == {"acquired": 5, "recorded": 5, "reconstructed": 3, "lost": 3}
    assert recording.run["devices"] == FACTS["devices"]
    for index, record in enumerate(records):
        frame, line = recording.frame(index), recording.line(index)
        np.testing.assert_array_equal(frame.pixels, record.frame.pixels)
        assert frame.pixels.dtype == np.uint16
        for field in fields(Frame)[1:]:
            assert getattr(frame, field.name) == getattr(record.frame, field.name)
        assert (line.index, line.lost, line.problem) == (index, record.lost, record.problem)
        for found, expected in (
            (recording.displacement(index), record.displacement),
            (recording.coefficients(index), record.coefficients),
        ):
            assert (found is None) == (expected is None)
            if expected is not None:
                np.testing.assert_array_equal(found, expected)
    lines = [recording.line(index) for index in range(5)]
    assert [line.calibration for line in lines] == [0, 0, 0, 1, None]
    assert [line.bias for line in lines] == [None, None, 0, None, None]
    assert [line.start for line in lines] == [-1, None, 0, None, None]
    assert [line.is_light_on for line in lines] == [True] * 4 + [None]
    np.testing.assert_array_equal(recording.start(0), before)
    np.testing.assert_array_equal(recording.start(2), first.displacement)
    np.testing.assert_array_equal(recording.bias(0), bias)
    views = first.views
    assert views is not None
    assert lines[0].rms_rad == pytest.approx(views.std(axis=(2, 3)).mean())


def test_zarrs_own_library_and_ome_readers_find_the_same(
    tmp_path: Path, calibration: Calibration, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(frame_array, "_STEP", 4)  # so that the arrays grow
    records = [*make_chain(calibration, 9), make_record(9)]
    write(tmp_path / "growing", records, finish=False)
    assert zarr.open_array(tmp_path / "growing" / "frames.zarr" / "0", mode="r").shape == (12, *SHAPE)
    write(tmp_path / "r", records)
    group = zarr.open_group(tmp_path / "r" / "frames.zarr", mode="r")
    frames = group["0"]
    assert isinstance(frames, zarr.Array)
    assert frames.shape == (10, *SHAPE)
    assert frames.metadata.dimension_names == ("t", "y", "x")  # type: ignore[union-attr] # of Zarr v3
    np.testing.assert_array_equal(frames[:], [record.frame.pixels for record in records])
    coefficients = np.asarray(group["results/0/coefficients"])
    np.testing.assert_array_equal(coefficients[:9], [record.coefficients for record in records[:9]])
    assert np.isnan(coefficients[9]).all()
    image: Any = group.attrs["ome"]
    assert image["version"] == "0.5"
    (scales,) = image["multiscales"]
    assert [axis["name"] for axis in scales["axes"]] == ["t", "y", "x"]
    assert scales["datasets"][0]["path"] == "0"


def test_a_calibration_comes_back_bit_for_bit(tmp_path: Path, calibration: Calibration) -> None:
    write(tmp_path / "r", [make_record(0, calibration)])
    found = Recording(tmp_path / "r").calibration(0)
    assert found.lattice == calibration.lattice
    assert write_bench(found.bench) == write_bench(replace(calibration.bench, lattice=calibration.lattice))
    assert found.full_scale == calibration.full_scale
    for kept, average in ((found.dark, calibration.dark), (found.reference, calibration.reference)):
        assert kept is not None
        assert average is not None
        for field in fields(Average):
            np.testing.assert_array_equal(getattr(kept, field.name), getattr(average, field.name))
        assert kept.mean.dtype == np.float32
    frame = np.asarray(calibration.reference.mean + 20, np.uint16)
    ours, theirs = calibration.reconstructor()(frame), found.reconstructor()(frame)
    np.testing.assert_array_equal(ours.views, theirs.views)


@pytest.mark.parametrize("partly", [False, True])
def test_a_full_disk_ends_the_recording_with_all_that_was_acknowledged(
    tmp_path: Path, calibration: Calibration, monkeypatch: pytest.MonkeyPatch, partly: bool
) -> None:
    put = FrameArray.write

    def fill_up(array: FrameArray, index: int, values: Floats) -> int:
        written = put(array, index, values)
        if index == 5 and (values.dtype != np.uint16 or not partly):
            raise OSError(errno.ENOSPC, "No space left on device", "the disk")
        return written

    monkeypatch.setattr(FrameArray, "write", fill_up)
    records = make_chain(calibration, 12)
    recording = BackgroundRecording(tmp_path / "r", FACTS, Timings(), records=records)
    state = wait(recording, {"ended early"})
    assert (state.frames, state.waiting) == (5, 0)
    assert state.problem == "the disk: cannot be written: No space left on device"
    recording.take(records[0])  # the live view goes on
    read = Recording(tmp_path / "r")
    assert (len(read), read.is_complete, read.ended_early) == (5, True, state.problem)
    np.testing.assert_array_equal(read.pixels(4), records[4].frame.pixels)
    assert read.run["frames"]["acquired"] == 12
    assert not read.is_whole(5)  # what was begun has made room to finish


def test_a_line_that_finds_half_the_room_it_needs_is_taken_back(
    tmp_path: Path, calibration: Calibration, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Filling:
        """A file on a disk that is full after so many bytes."""

        def __init__(self, file: Any, room: int) -> None:
            self._file, self._room = file, room

        def write(self, data: memoryview) -> int:
            if not self._room:
                raise OSError(errno.ENOSPC, "No space left on device")
            written = self._file.write(data[: self._room])
            self._room -= written
            return int(written)

        def __getattr__(self, name: str) -> Any:
            return getattr(self._file, name)

    begin = RunWriter.__init__

    def begin_on_full_disk(writer: RunWriter, folder: Path, facts: Any) -> None:
        begin(writer, folder, facts)
        writer._lines = Filling(writer._lines, 1000)  # type: ignore[assignment] # it acts like one

    monkeypatch.setattr(RunWriter, "__init__", begin_on_full_disk)
    recording = BackgroundRecording(tmp_path / "r", FACTS, Timings(), records=make_chain(calibration, 9))
    state = wait(recording, {"ended early"})
    assert state.problem == f"{tmp_path / 'r'}: cannot be written: No space left on device"
    read = Recording(tmp_path / "r")
    assert len(read) == state.frames == read.run["frames"]["recorded"] > 0
    assert (tmp_path / "r" / "frames.jsonl").read_text().endswith("}\n")


def test_a_disk_that_takes_nothing_at_all_leaves_what_recover_finishes(
    tmp_path: Path, calibration: Calibration, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise OSError(errno.EIO, "Input/output error", "the disk")

    def fail_to_finish(*_: object, **__: object) -> None:
        raise OSError(errno.EROFS, "Read-only file system", "the disk")

    recording = BackgroundRecording(tmp_path / "r", FACTS, Timings(), records=make_chain(calibration, 4))
    while recording.state.frames < 4:
        time.sleep(0.005)
    with monkeypatch.context() as broken:
        broken.setattr(FrameArray, "write", fail)
        broken.setattr(FrameArray, "set_length", fail_to_finish)
        recording.take(make_record(4, calibration))
        state = wait(recording, {"ended early"})
    assert state.problem == "the disk: cannot be written: Input/output error"
    assert not Recording(tmp_path / "r").is_complete
    assert recover(tmp_path / "r").frames == 4
    assert Recording(tmp_path / "r").is_complete


def test_a_disk_that_cannot_follow_ends_the_recording_and_nobody_waits_for_it(
    tmp_path: Path, calibration: Calibration, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(background, "_QUEUED_FRAMES", 8)
    is_free, put = threading.Event(), FrameArray.write

    def slowly(array: FrameArray, index: int, values: Floats) -> int:
        is_free.wait(20)
        return put(array, index, values)

    monkeypatch.setattr(FrameArray, "write", slowly)
    recording = BackgroundRecording(tmp_path / "r", FACTS, Timings())
    for record in make_chain(calibration, 20):  # on a disk that writes nothing
        recording.take(record)
    state = recording.state
    assert state.stage == "finishing"
    assert "cannot follow: 8 frames" in state.problem
    is_free.set()
    assert wait(recording, {"ended early"}).frames in {8, 9}  # what was in the queue, and perhaps in the writer's hand
    assert Recording(tmp_path / "r").ended_early == state.problem


def test_the_queue_is_bounded_in_bytes_too(
    tmp_path: Path, calibration: Calibration, monkeypatch: pytest.MonkeyPatch
) -> None:
    record = make_record(0, calibration)
    monkeypatch.setattr(background, "_QUEUED_BYTES", 2.5 * record.nbytes)
    is_free = threading.Event()
    monkeypatch.setattr(FrameArray, "write", lambda *_: is_free.wait(20))
    recording = BackgroundRecording(tmp_path / "r", FACTS, Timings())
    for _ in range(5):
        recording.take(record)
    assert "cannot follow" in recording.state.problem
    is_free.set()
    recording.join()


def test_a_sync_that_fails_is_not_swallowed(
    tmp_path: Path, calibration: Calibration, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(_: RunWriter) -> None:
        raise OSError(errno.EIO, "Input/output error")

    recording = BackgroundRecording(tmp_path / "r", FACTS, Timings())
    monkeypatch.setattr(background, "_SYNC_S", 0.0)
    monkeypatch.setattr(RunWriter, "sync", fail)
    for record in make_chain(calibration, 3):
        recording.take(record)
        time.sleep(0.05)
    assert "Input/output error" in wait(recording, {"ended early"}).problem


def test_a_sync_is_asked_of_the_operating_system(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Else a power cut would take lines that had long been acknowledged."""
    synced: list[int] = []
    monkeypatch.setattr("os.fsync", lambda number: synced.append(os.fstat(number).st_ino))
    with closing(RunWriter(tmp_path / "r", FACTS)) as writer:
        writer.sync()
    assert synced == [(tmp_path / "r" / "frames.jsonl").stat().st_ino]


def test_another_size_of_frames_ends_the_recording(tmp_path: Path) -> None:
    recording = BackgroundRecording(tmp_path / "r", FACTS, Timings())
    recording.take(make_record(0))
    recording.take(make_record(1, frame=make_frame(1, (8, 8))))
    state = wait(recording, {"ended early"})
    assert "frame 1" in state.problem
    assert "from 6 x 10 to 8 x 8" in state.problem
    assert len(Recording(tmp_path / "r")) == 1


def measurement(index: int, *, host_time_s: float, lost: int = 0) -> Measurement:
    frame = replace(make_frame(index), host_time_s=host_time_s)
    return Measurement(frame, None, "dark", Counts(index + 1, 0, lost), host_time_s, 0.01)


def test_a_recorder_ends_by_itself_after_so_many_frames(tmp_path: Path) -> None:
    recorder_ = Recorder(Timings())
    recorder_.take(measurement(0, host_time_s=0.0, lost=2))
    recorder_.start(tmp_path / "r", FACTS, frames=3)
    for index in range(1, 9):
        recorder_.take(measurement(index, host_time_s=index / 10, lost=4 if index > 1 else 2))
    assert wait(recorder_, {"finished"}).frames == 3
    recording = Recording(tmp_path / "r")
    assert recording.run["frames"] == {"acquired": 3, "recorded": 3, "reconstructed": 0, "lost": 2}
    assert [recording.line(index).camera_index for index in range(3)] == [1, 2, 3]
    assert [recording.line(index).lost for index in range(3)] == [0, 2, 0]
    recorder_.start(tmp_path / "again", FACTS)
    recorder_.close("the camera was unplugged")
    assert Recording(tmp_path / "again").ended_early == "the camera was unplugged"
    assert len(Recording(tmp_path / "again")) == 0


def test_the_last_seconds_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recorder_ = Recorder(Timings())
    with pytest.raises(InputError, match="no frame yet"):
        recorder_.keep_recent(tmp_path / "none", FACTS)
    taken = [measurement(index, host_time_s=index / 10) for index in range(301)]
    for each in taken:
        recorder_.take(each)
    recorder_.keep_recent(tmp_path / "r", FACTS)
    recorder_.close("")
    recording = Recording(tmp_path / "r")
    assert [recording.line(at).camera_index for at in range(len(recording))] == list(range(200, 301))  # 10 s
    np.testing.assert_array_equal(recording.pixels(100), taken[300].frame.pixels)

    monkeypatch.setattr(recorder, "_RECENT_BYTES", 10 * taken[0].frame.pixels.nbytes)
    recorder_.take(measurement(301, host_time_s=30.1))
    assert recorder_.recent_frames == 10


def test_free_space_is_told_in_minutes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Path] = []

    def usage(path: Path) -> SimpleNamespace:
        asked.append(path)
        return SimpleNamespace(free=60 * 10 * 120 * 7)  # seven minutes of ten frames of 120 bytes a second

    monkeypatch.setattr("app.recording.recorder.shutil.disk_usage", usage)
    recorder_ = Recorder(Timings())
    assert recorder_.free_minutes(tmp_path) == math.inf
    for index in range(101):
        recorder_.take(measurement(index, host_time_s=index / 10))
    assert recorder_.free_minutes(tmp_path / "not" / "yet") == pytest.approx(7, rel=0.02)
    assert asked == [tmp_path]


def test_a_folder_that_cannot_be_is_refused_before_anything_is_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("in the way")
    for folder, said in (
        (tmp_path / "file" / "deep" / "er", "file: is no folder"),
        (tmp_path / ("a" * 300), "too long"),
    ):
        with pytest.raises(InputError, match=said):
            Recorder(Timings()).start(folder, FACTS)
    monkeypatch.setattr("os.access", lambda *_: False)  # as for anybody but root in somebody else's folder
    with pytest.raises(InputError, match="nothing may be written there"):
        Recorder(Timings()).start(tmp_path / "new" / "er", FACTS)
    assert list(tmp_path.iterdir()) == [tmp_path / "file"]


def test_a_folder_that_holds_a_recording_is_refused(tmp_path: Path) -> None:
    write(tmp_path / "r", [make_record(0)])
    recorder_ = Recorder(Timings())
    for begin in (recorder_.start, recorder_.keep_recent):
        with pytest.raises(InputError, match="holds a recording already"):
            begin(tmp_path / "r", FACTS)
    assert len(Recording(tmp_path / "r")) == 1
    recorder_.start(tmp_path / "new", FACTS)
    with pytest.raises(InputError, match="new: is still being recorded"):
        recorder_.start(tmp_path / "newer", FACTS)
    recorder_.close("")


def test_it_can_be_read_while_it_grows(tmp_path: Path, calibration: Calibration) -> None:
    records = make_chain(calibration, 3)
    writer = RunWriter(tmp_path / "r", FACTS)
    recording = Recording(tmp_path / "r")
    assert (len(recording), recording.is_complete) == (0, False)
    for index, record in enumerate(records):
        writer.write(record)
        assert recording.refresh() == index + 1
        np.testing.assert_array_equal(recording.pixels(index), record.frame.pixels)
        np.testing.assert_array_equal(recording.coefficients(index), record.coefficients)
    with pytest.raises(InputError, match="still being recorded"):
        recover(tmp_path / "r")
    writer.finish("", acquired=3, facts={})
    writer.close()
    recording.refresh()
    assert recording.is_complete
    assert recover(tmp_path / "r").was_complete


def test_recovering_twice_and_a_half_line(tmp_path: Path, calibration: Calibration) -> None:
    records = make_chain(calibration, 5)
    write(tmp_path / "r", [replace(records[0], lost=4), *records[1:]], finish=False)
    path = tmp_path / "r" / "frames.jsonl"
    whole = path.read_bytes()
    path.write_bytes(whole + whole.splitlines()[-1][:40])
    assert len(Recording(tmp_path / "r")) == 5
    found = recover(tmp_path / "r")
    assert (found.was_complete, found.frames, found.reconstructed) == (False, 5, 5)
    assert (found.lost, found.gaps, found.left_out) == (4, 1, "")
    assert path.read_bytes() == whole
    assert zarr.open_array(tmp_path / "r" / "frames.zarr" / "0", mode="r").shape == (5, *SHAPE)
    assert zarr.open_array(tmp_path / "r/frames.zarr/results/0/displacement", mode="r").shape[0] == 5
    everything = {path: path.read_bytes() for path in (tmp_path / "r").rglob("*") if path.is_file()}
    assert recover(tmp_path / "r") == replace(found, was_complete=True)
    assert {path: path.read_bytes() for path in (tmp_path / "r").rglob("*") if path.is_file()} == everything
    assert "recovered" in Recording(tmp_path / "r").ended_early


def test_a_recording_that_had_just_begun_is_recovered(tmp_path: Path) -> None:
    write(tmp_path / "r", [], finish=False)
    (tmp_path / "r" / "frames.jsonl").unlink()
    assert recover(tmp_path / "r").frames == 0
    assert len(Recording(tmp_path / "r")) == 0


def _cut_short(folder: Path) -> None:
    chunk = folder / "frames.zarr" / "0" / "c" / "3" / "0" / "0"
    chunk.write_bytes(chunk.read_bytes()[:50])


def _spoil(folder: Path) -> None:
    lines = (folder / "frames.jsonl").read_bytes().splitlines(keepends=True)
    (folder / "frames.jsonl").write_bytes(b"".join([*lines[:3], b"\0" * 20 + b"\n", *lines[4:]]))


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (_cut_short, "frame 3 are not whole"),
        (lambda folder: (folder / "frames.zarr/0/c/3/0/0").unlink(), "frame 3 are not whole"),
        (_spoil, "line 4 is damaged"),
    ],
)
def test_after_a_power_cut_what_is_whole_is_kept_and_nothing_thrown_away(
    tmp_path: Path, calibration: Calibration, damage: Callable[[Path], None], said: str
) -> None:
    write(tmp_path / "r", make_chain(calibration, 6), finish=False)
    damage(tmp_path / "r")
    text = (tmp_path / "r" / "frames.jsonl").read_bytes()
    with pytest.raises(InputError):
        Recording(tmp_path / "r").frame(3)
    found = recover(tmp_path / "r")
    assert found.frames == 3
    assert said in found.left_out
    kept = (tmp_path / "r" / "frames.jsonl").read_bytes()
    assert kept + (tmp_path / "r" / "frames.damaged.jsonl").read_bytes() == text
    assert kept.count(b"\n") == 3
    assert (tmp_path / "r/frames.zarr/0/c/5/0/0").exists()


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda folder: None, "no such folder"),
        (lambda folder: folder.write_text("x"), "is no folder"),
        (lambda folder: folder.mkdir(), "holds no recording"),
        (lambda folder: (folder.mkdir(), (folder / "run.json").write_text("{")), "cannot be read"),
        (lambda folder: (folder.mkdir(), (folder / "run.json").write_bytes(b"\xff\xfe")), "cannot be read"),
        (lambda folder: (folder.mkdir(), (folder / "run.json").write_text('{"command": "live"}')), "not that of a rec"),
        (lambda folder: (folder.mkdir(), (folder / "run.json").write_text("[]")), "not that of a rec"),
    ],
)
def test_a_folder_that_is_no_recording_is_told(tmp_path: Path, make: Callable[[Path], object], said: str) -> None:
    make(tmp_path / "r")
    for use in (Recording, recover):
        with pytest.raises(InputError, match=said):
            use(tmp_path / "r")


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
        (lambda r: (r / "frames.zarr/0/zarr.json").write_text("{}"), lambda r: r.pixels(0), "no array of a recording"),
        (lambda r: (r / "frames.zarr/0/zarr.json").unlink(), lambda r: r.pixels(0), "pixels of frame 0 are missing"),
    ],
)
def test_whatever_is_missing_or_damaged_is_told_by_its_name(
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


def test_lines_in_another_order_are_not_taken_for_right(tmp_path: Path) -> None:
    write(tmp_path / "r", [make_record(0), make_record(1)])
    path = tmp_path / "r" / "frames.jsonl"
    path.write_text("".join(reversed(path.read_text().splitlines(keepends=True))))
    with pytest.raises(InputError, match="line 1 is of frame 1"):
        Recording(tmp_path / "r").line(0)


def test_lines_are_json_that_any_program_reads(tmp_path: Path, calibration: Calibration) -> None:
    dark = make_record(0, calibration, views=np.full((3, 3, 7, 9), np.nan))
    write(tmp_path / "r", [dark, make_record(1)])

    def refuse(constant: str) -> None:
        raise AssertionError(constant)

    for line in (tmp_path / "r" / "frames.jsonl").read_text().splitlines():
        assert json.loads(line, parse_constant=refuse)["rms_rad"] is None
