"""Recording to a disk that is full, fails or is too slow."""

from __future__ import annotations

import errno
import itertools
import os
import threading
import time
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.optics import SmallBench
from support.patience import HANG_S, wait_until
from support.records import FACTS, make_record, make_records, noisy_calibration, wait

from app.measurement.calibration import Calibration
from app.recording import recorder
from app.recording.frame_array import FrameArray
from app.recording.reader import Recording
from app.recording.recorder import BackgroundRecording
from app.recording.recover import recover
from app.recording.writer import RecordingWriter
from app.timing import Timings
from reconstruction.arrays import Floats


@pytest.fixture(scope="module")
def calibration(small_bench: SmallBench) -> Calibration:
    return noisy_calibration(small_bench)


@pytest.mark.parametrize("partly", [False, True])
def test_full_disk_keeps_all_acknowledged_frames(
    tmp_path: Path, calibration: Calibration, monkeypatch: pytest.MonkeyPatch, partly: bool
) -> None:
    put = FrameArray.write

    def fill_up(array: FrameArray, index: int, values: Floats) -> None:
        put(array, index, values)
        if index == 5 and (values.dtype != np.uint16 or not partly):
            raise OSError(errno.ENOSPC, "No space left on device", "the disk")

    monkeypatch.setattr(FrameArray, "write", fill_up)
    records = make_records(calibration, 12)
    recording = BackgroundRecording(tmp_path / "r", FACTS, Timings(), records=records)
    state = wait(recording, {"ended early"})
    assert (state.frames, state.waiting) == (5, 0)
    assert state.problem == "the disk: cannot be written: No space left on device"
    recording.take(records[0])  # the live view goes on
    read = Recording(tmp_path / "r")
    assert (len(read), read.is_complete, read.ended_early) == (5, True, state.problem)
    np.testing.assert_array_equal(read.pixels(4), records[4].made.frame.pixels)
    assert read.run["frames"]["acquired"] == 12
    pixels = FrameArray(tmp_path / "r" / "frames.zarr" / "0").read(5)
    assert pixels is not None
    assert not pixels.any()  # the unfinished frame was removed, and its chunk filled up


def test_half_written_line_is_removed(
    tmp_path: Path, calibration: Calibration, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Filling:
        """A file on a disk with room for so many bytes."""

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

    begin = RecordingWriter.__init__

    def begin_on_full_disk(writer: RecordingWriter, folder: Path, facts: Any) -> None:
        begin(writer, folder, facts)
        writer._lines = Filling(writer._lines, 1000)  # type: ignore[assignment] # it acts like one

    monkeypatch.setattr(RecordingWriter, "__init__", begin_on_full_disk)
    recording = BackgroundRecording(tmp_path / "r", FACTS, Timings(), records=make_records(calibration, 9))
    state = wait(recording, {"ended early"})
    assert state.problem == f"{tmp_path / 'r'}: cannot be written: No space left on device"
    read = Recording(tmp_path / "r")
    assert len(read) == state.frames == read.run["frames"]["recorded"] > 0
    assert (tmp_path / "r" / "frames.jsonl").read_text().endswith("}\n")


def test_recover_finishes_after_a_disk_without_any_space(
    tmp_path: Path, calibration: Calibration, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise OSError(errno.EIO, "Input/output error", "the disk")

    def fail_to_finish(*_: object, **__: object) -> None:
        raise OSError(errno.EROFS, "Read-only file system", "the disk")

    recording = BackgroundRecording(tmp_path / "r", FACTS, Timings(), records=make_records(calibration, 4))
    while recording.state.frames < 4:
        time.sleep(0.005)
    with monkeypatch.context() as broken:
        broken.setattr(FrameArray, "write", fail)
        broken.setattr(FrameArray, "finish", fail_to_finish)
        recording.take(make_record(4, calibration))
        state = wait(recording, {"ended early"})
    assert state.problem == "the disk: cannot be written: Input/output error"
    assert not Recording(tmp_path / "r").is_complete
    assert recover(tmp_path / "r").frames == 4
    assert Recording(tmp_path / "r").is_complete


def test_slow_disk_ends_the_recording_without_blocking(
    tmp_path: Path, calibration: Calibration, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder, "_QUEUED_FRAMES", 8)
    is_free, put = threading.Event(), FrameArray.write

    def slowly(array: FrameArray, index: int, values: Floats) -> None:
        is_free.wait(HANG_S)
        return put(array, index, values)

    monkeypatch.setattr(FrameArray, "write", slowly)
    recording = BackgroundRecording(tmp_path / "r", FACTS, Timings())
    for record in make_records(calibration, 20):  # on a disk that writes nothing
        recording.take(record)
    state = recording.state
    assert state.stage == "finishing"
    assert "cannot follow: 8 frames" in state.problem
    is_free.set()
    assert wait(recording, {"ended early"}).frames in {8, 9}  # in the queue, and perhaps one in the writer
    assert Recording(tmp_path / "r").ended_early == state.problem


def test_queue_is_bounded_in_bytes(tmp_path: Path, calibration: Calibration, monkeypatch: pytest.MonkeyPatch) -> None:
    record = make_record(0, calibration)
    monkeypatch.setattr(recorder, "_QUEUED_BYTES", 2.5 * record.nbytes)
    is_free = threading.Event()
    monkeypatch.setattr(FrameArray, "write", lambda *_: is_free.wait(HANG_S))
    recording = BackgroundRecording(tmp_path / "r", FACTS, Timings())
    for _ in range(5):
        recording.take(record)
    assert "cannot follow" in recording.state.problem
    is_free.set()
    recording.join()


def test_failed_sync_ends_the_recording(
    tmp_path: Path, calibration: Calibration, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(_: RecordingWriter) -> None:
        raise OSError(errno.EIO, "Input/output error")

    recording = BackgroundRecording(tmp_path / "r", FACTS, Timings())
    monkeypatch.setattr(recorder, "_SYNC_S", 0.0)
    monkeypatch.setattr(RecordingWriter, "sync", fail)
    records = itertools.cycle(make_records(calibration, 3))

    def has_ended() -> bool:  # a later frame finds out that the sync has failed
        if not recording.state.waiting:
            recording.take(next(records))
        return recording.state.stage == "ended early"

    wait_until(has_ended)
    assert "Input/output error" in recording.state.problem


def test_sync_calls_fsync(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without fsync, a power failure would lose acknowledged lines."""
    synced: list[int] = []
    monkeypatch.setattr("os.fsync", lambda number: synced.append(os.fstat(number).st_ino))
    with closing(RecordingWriter(tmp_path / "r", FACTS)) as writer:
        writer.sync()
    assert synced[-1] == (tmp_path / "r" / "frames.jsonl").stat().st_ino
