"""Recorder: beginning and end of recordings, recent frames, folders."""

from __future__ import annotations

import errno
import math
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from support.optics import SmallBench
from support.paths import ROOT
from support.patience import HANG_S, wait_until
from support.records import FACTS, make_frame, make_record, noisy_calibration, wait, write
from support.windows import refusing

from app.errors import InputError, RunError
from app.measurement.measurement import FrameTotals, Gap, Measurement
from app.recording import recorder, writer
from app.recording.reader import Recording
from app.recording.recorder import BackgroundRecording, Recorder, RecordingLimit
from app.recording.writer import RecordingWriter
from app.timing import Timings


def measurement(index: int, *, host_time_s: float, lost: int = 0) -> Measurement:
    frame = replace(make_frame(index), host_time_s=host_time_s)
    return Measurement(frame, None, "dark", FrameTotals(index + 1, 0, lost), host_time_s, 0.01, lost=lost)


def test_recording_ends_after_the_requested_frames(tmp_path: Path) -> None:
    recorder_ = Recorder(Timings())
    recorder_.take(measurement(0, host_time_s=0.0, lost=2))
    recorder_.start(tmp_path / "r", FACTS, limit=RecordingLimit(frames=3))
    for index in range(1, 9):
        recorder_.take(measurement(index, host_time_s=index / 10, lost=2 if index == 2 else 0))
    assert wait(recorder_, {"finished"}).frames == 3
    recording = Recording(tmp_path / "r")
    assert recording.run["frames"] == {"acquired": 3, "recorded": 3, "reconstructed": 0, "lost": 2}
    assert [recording.line(index).camera_index for index in range(3)] == [1, 2, 3]
    assert [recording.line(index).lost for index in range(3)] == [0, 2, 0]
    recorder_.start(tmp_path / "again", FACTS)
    recorder_.close("the camera was unplugged")
    assert Recording(tmp_path / "again").ended_early == "the camera was unplugged"
    assert len(Recording(tmp_path / "again")) == 0


def test_recording_is_prepared_before_its_first_frame_and_without_zarr(tmp_path: Path) -> None:
    """In a program of its own: importing Zarr would stop the live path for half a second."""
    script = (
        "import sys, time; from pathlib import Path; from support.records import FACTS, make_record; "
        "from app.recording.recorder import Recorder; from app.timing import Timings; "
        "recorder = Recorder(Timings()); recorder.take(make_record(0).made); "
        "recorder.start(Path('r'), FACTS); "
        "end_s = time.monotonic() + 30\n"
        "while not Path('r/frames.zarr/0/c').is_dir() and time.monotonic() < end_s: time.sleep(0.01)\n"
        "before = set(sys.modules); recorder.take(make_record(1).made); recorder.close('')\n"
        "assert recorder.state.frames == 1\n"
        "print(sorted(set(sys.modules) - before), 'zarr' in sys.modules)"
    )
    paths = {"PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests")])}
    made = subprocess.run(  # noqa: S603 - our own
        [sys.executable, "-c", script],
        cwd=tmp_path,
        env=os.environ | paths,
        capture_output=True,
        text=True,
        check=False,
    )
    assert made.stdout == "[] False\n", made.stderr


@pytest.mark.parametrize("may_rename", [False, True])
def test_folder_with_an_impossible_name_is_refused(may_rename: bool) -> None:
    with pytest.raises(InputError, match=r"embedded null|cannot contain control characters"):
        Recorder(Timings()).start(Path("no\0name"), FACTS, may_rename=may_rename)


def test_preparation_leaves_nothing_without_frames(tmp_path: Path, small_bench: SmallBench) -> None:
    recorder_ = Recorder(Timings())
    recorder_.take(replace(make_record(0, noisy_calibration(small_bench)).made, problem="dark"))
    recorder_.start(tmp_path / "r", FACTS)
    recorder_.stop()
    assert wait(recorder_, {"finished"}).frames == 0
    assert {each.name for each in (tmp_path / "r").iterdir()} == {"run.json", "frames.jsonl"}


def test_recording_ends_after_the_requested_time(tmp_path: Path) -> None:
    """Frames at 0.1 ... 0.6 s; 0.3 s after the first is the fourth."""
    recorder_ = Recorder(Timings())
    recorder_.start(tmp_path / "r", FACTS, limit=RecordingLimit(seconds=0.3 + 1e-6))
    for index in range(1, 7):
        recorder_.take(measurement(index, host_time_s=index / 10))
    assert wait(recorder_, {"finished"}).frames == 4
    assert not Recording(tmp_path / "r").ended_early


def test_limit_can_change_during_a_recording(tmp_path: Path) -> None:
    recorder_ = Recorder(Timings())
    recorder_.start(tmp_path / "r", FACTS, limit=RecordingLimit(frames=2))
    recorder_.take(measurement(1, host_time_s=0.1))
    recorder_.limit(RecordingLimit(frames=5))
    for index in range(2, 5):
        recorder_.take(measurement(index, host_time_s=index / 10))
    recorder_.limit(RecordingLimit(frames=3))  # fewer than there are: no further one
    recorder_.take(measurement(5, host_time_s=0.5))
    assert wait(recorder_, {"finished"}).frames == 4
    assert Recording(tmp_path / "r").run["frames"]["acquired"] == 4


def test_frames_that_are_written_wait_no_more(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Eight frames, where three may wait for the disk."""
    taken = [measurement(index, host_time_s=index / 10) for index in range(8)]
    monkeypatch.setattr(recorder, "_QUEUED_BYTES", 3 * taken[0].frame.pixels.nbytes)
    recorder_ = Recorder(Timings())
    recorder_.start(tmp_path / "r", FACTS, limit=RecordingLimit(frames=len(taken)))
    for each in taken:
        recorder_.take(each)
        wait_until(lambda: recorder_.state is not None and not recorder_.state.waiting)
    assert wait(recorder_, {"finished", "ended early"}).problem == ""
    assert len(Recording(tmp_path / "r")) == len(taken)


def test_recent_frames_can_be_saved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
    assert recording.run["frames"]["acquired"] == 101
    np.testing.assert_array_equal(recording.pixels(100), taken[300].frame.pixels)

    monkeypatch.setattr(recorder, "_RECENT_BYTES", 10 * taken[0].frame.pixels.nbytes)
    recorder_.take(measurement(301, host_time_s=30.1))
    assert len(recorder_._recent) == 10


def test_gap_before_the_first_frame_is_none_of_the_recording(tmp_path: Path) -> None:
    records = [make_record(index, gap=Gap(2.0 + index, "a new reference")) for index in range(2)]
    made = write(tmp_path / "r", records)
    recording = Recording(tmp_path / "r")
    assert [recording.line(index).gap_s for index in range(2)] == [0.0, 3.0]
    assert made.gaps == [Gap(3.0, "a new reference")]


def test_duration_stands_still_after_the_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clock_s = [100.0]
    monkeypatch.setattr(recorder, "time", SimpleNamespace(perf_counter=lambda: clock_s[0]))
    recording = BackgroundRecording(tmp_path / "r", FACTS, Timings())
    clock_s[0] = 103.0
    recording.stop()
    recording.join()
    clock_s[0] = 200.0
    assert recording.state.seconds == pytest.approx(3, rel=1e-3)


def test_free_space_is_given_in_minutes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
    recorder_.forget_recent()
    assert recorder_.free_minutes(tmp_path) == math.inf
    for index in range(101):
        recorder_.take(measurement(index, host_time_s=20 + index / 10))
    assert recorder_.free_minutes(tmp_path) == pytest.approx(7, rel=0.02)


def test_changed_frame_size_ends_the_recording(tmp_path: Path) -> None:
    recording = BackgroundRecording(tmp_path / "r", FACTS, Timings())
    recording.take(make_record(0))
    recording.take(make_record(1, frame=make_frame(1, (8, 8))))
    state = wait(recording, {"ended early"})
    assert "frame 1" in state.problem
    assert "from 6 x 10 to 8 x 8" in state.problem
    assert len(Recording(tmp_path / "r")) == 1


def test_impossible_folder_is_refused_before_measuring(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("in the way")
    for folder, said in (
        (tmp_path / "file" / "deep" / "er", "file: not a folder"),
        (tmp_path / ("a" * 300), "too long|has more than 255 characters"),
    ):
        with pytest.raises(InputError, match=said):
            Recorder(Timings()).start(folder, FACTS)
    monkeypatch.setattr("os.open", refusing(errno.EACCES))  # as in another user's folder
    with pytest.raises(InputError, match="no permission to write there"):
        Recorder(Timings()).start(tmp_path / "new" / "er", FACTS)
    assert list(tmp_path.iterdir()) == [tmp_path / "file"]


def test_folder_with_a_recording_is_refused(tmp_path: Path) -> None:
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


def test_recordings_started_in_one_second_get_numbered_folders(tmp_path: Path) -> None:
    recorder_ = Recorder(Timings())
    wanted, seconds = tmp_path / "here" / "20261121-093000", 3
    for index in range(seconds):
        recorder_.start(wanted, FACTS, may_rename=True)
        with pytest.raises(InputError, match="is still being recorded"):
            recorder_.start(wanted, FACTS, may_rename=True)
        recorder_.take(measurement(index, host_time_s=float(index)))
        recorder_.stop()
        wait(recorder_, {"finished"})
    recorder_.keep_recent(wanted, FACTS, may_rename=True)
    recorder_.close("")
    names = ["20261121-093000", *(f"20261121-093000-{number}" for number in (2, 3, 4))]
    assert sorted(path.name for path in wanted.parent.iterdir()) == names
    indices = [[Recording(wanted.parent / name).line(0).camera_index] for name in names[:3]]
    assert indices == [[0], [1], [2]]
    assert len(Recording(wanted.parent / names[3])) == seconds


def test_concurrent_programs_get_different_folders(tmp_path: Path) -> None:
    asks = "import sys; from pathlib import Path; from app.recording.folder import new_folder\n"
    asks += "for _ in range(40): print(new_folder(Path(sys.argv[1])).name)"
    command = [sys.executable, "-c", asks, str(tmp_path / "r")]
    programs = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(3)]  # noqa: S603 - ours
    names = [name for program in programs for name in program.communicate(timeout=HANG_S)[0].split()]
    assert len(names) == len(set(names)) == 120
    assert (
        {path.name for path in tmp_path.iterdir()} == set(names) == {"r", *(f"r-{number}" for number in range(2, 121))}
    )


def test_second_of_two_concurrent_writers_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(writer, "check_free", lambda _: None)  # both check before either begins
    first = RecordingWriter(tmp_path / "r", FACTS)
    before = (tmp_path / "r" / "run.json").read_bytes()
    with pytest.raises(InputError, match="is still being recorded"):
        RecordingWriter(tmp_path / "r", {**FACTS, "command": "measure"})
    assert (tmp_path / "r" / "run.json").read_bytes() == before
    first.write(make_record(0))
    first.close()
    assert len(Recording(tmp_path / "r")) == 1


def test_failed_beginning_leaves_no_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise RunError("the disk is full")

    with monkeypatch.context() as full:
        full.setattr(writer, "write_record", fail)
        with pytest.raises(RunError):
            RecordingWriter(tmp_path / "r", FACTS)
    assert not list((tmp_path / "r").iterdir())
    write(tmp_path / "r", [make_record(0)])
    assert len(Recording(tmp_path / "r")) == 1
