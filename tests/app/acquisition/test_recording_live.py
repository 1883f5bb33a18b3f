"""Recording during acquisition: every frame, with everything that reproduces its wavefront."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.gui_bench import BENCH, FakeCamera, opener
from support.patience import HANG_S, wait_until
from support.recording_crash import kill_one
from support.simulated_scene import lose_frames, unplug

from app.acquisition.devices import open_devices
from app.acquisition.frame_path import FramePath
from app.acquisition.instrument import Instrument
from app.acquisition.start_up import start_up
from app.acquisition.worker import Acquisition
from app.bench.config import Bench, load_bench
from app.errors import InputError
from app.measurement.measurement import SKIPPED, Measurement
from app.recording.reader import Recording
from app.recording.recorder import RecordingLimit, RecordingState
from app.recording.recover import recover
from app.recording.reprocess import reprocess
from app.results.replay import Verification
from drivers.interface import Devices, Frame, WrongState
from simulated_devices.camera import SimulatedCamera


class Live:
    """Started acquisition on the small simulated bench."""

    def __init__(self, toml: Path, *settings: str) -> None:
        self.measurements: list[Measurement] = []
        self.acquisition = Acquisition(load_bench(toml, settings), self._open, sinks=(self.measurements.append,))
        self.acquisition.start()
        for step in start_up(self.acquisition, 4):
            step.result(HANG_S)

    def _open(self, bench: Bench, progress: Callable[[float], None]) -> Devices:
        devices = open_devices(bench, progress)
        assert isinstance(devices.camera, SimulatedCamera)
        self.camera = devices.camera
        return devices

    def until_refined(self) -> None:
        wait_until(lambda: bool(self.measurements) and self.measurements[-1].assumed.refinement.stage == "applied")

    @property
    def recording(self) -> RecordingState:
        state = self.acquisition.recording
        assert state is not None
        return state

    def stop(self) -> None:
        self.acquisition.stop_recording()
        wait_until(lambda: self.recording.stage in {"finished", "ended early"})


@pytest.fixture
def make_live(quick_toml: Path) -> Iterator[Callable[..., Live]]:
    made: list[Live] = []

    def make(*settings: str) -> Live:
        made.append(Live(quick_toml, *settings))
        return made[-1]

    yield make
    for live in made:
        live.acquisition.close()


def assert_made_again(recording: Recording) -> None:
    """Check that every frame is reproduced."""
    verification = Verification(recording)
    for made in reprocess(recording):
        verification.take(made)
    assert verification.passes, verification.sentence


@pytest.fixture
def acquisition() -> Iterator[Acquisition]:
    """A running fake camera."""
    acquisition = Acquisition(BENCH, opener(FakeCamera()))
    acquisition.start()
    acquisition.set_running(True).result(HANG_S)
    yield acquisition
    acquisition.close()


@contextmanager
def busy(acquisition: Acquisition) -> Iterator[None]:
    """Let commands wait until the end of the block."""
    is_free = threading.Event()
    waiting = acquisition.commands.submit(lambda _: is_free.wait(HANG_S))
    yield
    is_free.set()
    assert waiting.result(HANG_S)


def test_stop_and_limit_hold_for_a_recording_that_waits_for_its_start(acquisition: Acquisition, tmp_path: Path) -> None:
    def is_finished() -> bool:
        return acquisition.recording is not None and acquisition.recording.stage == "finished"

    with busy(acquisition):
        start, stop = acquisition.start_recording(tmp_path / "stopped"), acquisition.stop_recording()
        assert stop.done()
    start.result(HANG_S)
    wait_until(is_finished)
    with busy(acquisition):
        start = acquisition.start_recording(tmp_path / "limited")
        assert acquisition.limit_recording(RecordingLimit(frames=2)).done()
    start.result(HANG_S)
    wait_until(is_finished)
    assert len(Recording(tmp_path / "limited")) == 2


def test_file_that_is_shown_is_never_part_of_a_recording(acquisition: Acquisition, tmp_path: Path) -> None:
    with busy(acquisition):
        start = acquisition.start_recording(tmp_path / "camera", limit=RecordingLimit(frames=2))
        shown = acquisition.show_file(tmp_path / "file.npy")
    start.result(HANG_S)
    with pytest.raises(WrongState, match="is not shown during a recording"):
        shown.result(HANG_S)


def test_reconstruction_of_a_single_frame_that_takes_seconds_is_an_activity(
    acquisition: Acquisition, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[str] = []
    monkeypatch.setattr(FramePath, "process_single", lambda *_: seen.append(acquisition.activity.text))

    def refine(instrument: Instrument) -> None:
        bench = instrument.bench
        instrument.bench = replace(bench, reconstruction=replace(bench.reconstruction, refine=True))

    frame: Any = None
    acquisition.show_single(lambda _: frame).result(HANG_S)
    acquisition.show_single(lambda _: frame, "file.npy").result(HANG_S)
    acquisition.commands.submit(refine).result(HANG_S)
    acquisition.show_single(lambda _: frame).result(HANG_S)
    assert seen == ["", "reconstructing the frame", "reconstructing the frame"]
    assert not acquisition.activity.text


@pytest.mark.slow
@pytest.mark.long
def test_recorded_frames_are_reproduced(make_live: Callable[..., Live], tmp_path: Path) -> None:
    live = make_live("reconstruction.refine=true")
    live.until_refined()
    live.acquisition.start_recording(tmp_path / "r").result(HANG_S)
    wait_until(lambda: live.recording.frames > 10)
    live.acquisition.commands.submit(lambda instrument: instrument.devices.light.set_current(0.3)).result(HANG_S)
    old = live.measurements[-1].calibration
    live.acquisition.commands.submit(lambda instrument: instrument.change_settings(())).result(HANG_S)
    wait_until(lambda: live.measurements[-1].calibration not in {None, old})
    live.until_refined()
    frames = live.recording.frames
    wait_until(lambda: live.recording.frames > frames + 10)
    live.stop()
    recording = Recording(tmp_path / "r")
    lines = [recording.line(index) for index in range(len(recording))]
    assert live.recording.frames == len(lines)
    assert {line.calibration for line in lines} == {0, 1}
    assert any(line.bias is not None for line in lines)
    assert [line.light_current_a for line in (lines[0], lines[-1])] == [0.35, 0.3]
    first = next(at for at, each in enumerate(live.measurements) if each.frame.index == lines[0].camera_index)
    for line, measurement in zip(lines, live.measurements[first:], strict=False):
        assert line.camera_index == measurement.frame.index
        np.testing.assert_array_equal(recording.pixels(line.index), measurement.frame.pixels)
    assert set(recording.run["devices"]) == {"camera", "light", "stage"}
    assert recording.bench == load_bench_of(live)
    assert_made_again(recording)


def load_bench_of(live: Live) -> Bench:
    status = live.acquisition.status
    assert status is not None
    return status.bench


def measure_slowly(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the reconstruction slower than the camera."""
    measure = Instrument.measure

    def slowly(instrument: Instrument, frame: Frame) -> Measurement:
        time.sleep(0.2)
        return measure(instrument, frame)

    monkeypatch.setattr(Instrument, "measure", slowly)


@pytest.mark.slow
@pytest.mark.long
def test_gaps_and_skipped_frames_are_recorded(
    make_live: Callable[..., Live], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    live = make_live("camera.exposure_s=0.0139")
    live.acquisition.start_recording(tmp_path / "r").result(HANG_S)
    live.acquisition.commands.submit(lambda _: lose_frames(live.camera, 5)).result(HANG_S)  # not while a frame is read
    wait_until(lambda: live.recording.frames > 5)
    fast = len(live.measurements)
    measure_slowly(monkeypatch)
    wait_until(lambda: sum(each.problem == SKIPPED for each in live.measurements[fast:]) > 20)
    live.stop()
    recording = Recording(tmp_path / "r")
    lines = [recording.line(index) for index in range(len(recording))]
    assert sum(line.problem == SKIPPED for line in lines) > 20
    assert max(line.lost for line in lines) >= 5
    camera_index = np.array([line.camera_index for line in lines])
    assert np.diff(camera_index).tolist() == [line.lost + 1 for line in lines[1:]]
    assert_made_again(recording)
    assert all(made.wavefront is not None for made in reprocess(recording))  # skipped ones, too


def test_lost_camera_leaves_readable_recording(make_live: Callable[..., Live], tmp_path: Path) -> None:
    live = make_live()
    live.acquisition.start_recording(tmp_path / "r").result(HANG_S)
    wait_until(lambda: live.recording.frames > 5)
    unplug(live.camera)
    wait_until(lambda: not live.acquisition.is_alive)
    recording = Recording(tmp_path / "r")
    assert recording.is_complete
    assert "camera" in recording.ended_early
    assert recording.ended_early == live.acquisition.failure == live.recording.problem
    assert recording.line(len(recording) - 1).camera_index == live.measurements[-1].frame.index
    assert_made_again(recording)


@pytest.mark.slow
@pytest.mark.long
def test_recent_frames_are_kept_during_recording(make_live: Callable[..., Live], tmp_path: Path) -> None:
    live = make_live()
    wait_until(lambda: len(live.measurements) > 20)
    live.acquisition.start_recording(tmp_path / "r").result(HANG_S)
    live.acquisition.keep_recent(tmp_path / "kept").result(HANG_S)
    wait_until(lambda: live.recording.frames > 5)
    with pytest.raises(InputError, match="holds a recording already"):
        live.acquisition.keep_recent(tmp_path / "r").result(HANG_S)
    live.acquisition.close()  # finishes both
    for name in ("kept", "r"):
        recording = Recording(tmp_path / name)
        assert (recording.is_complete, recording.ended_early) == (True, "")
        assert_made_again(recording)
    kept, recorded = Recording(tmp_path / "kept"), Recording(tmp_path / "r")
    indexes = [each.frame.index for each in live.measurements]  # a slow computer loses frames
    assert kept.line(0).camera_index == indexes[0]
    last = indexes.index(kept.line(len(kept) - 1).camera_index)
    assert last + 1 >= indexes.index(recorded.line(0).camera_index)


@pytest.mark.posix
@pytest.mark.slow
@pytest.mark.long
def test_kill_at_random_moment_keeps_all_but_last_frames(quick_toml: Path, tmp_path: Path) -> None:
    """`recording_crash.py` counts the missing frames on a quiet computer; a busy one may lose more."""
    random = np.random.default_rng()
    for kill in range(2):
        folder = tmp_path / str(kill)
        left = kill_one(str(quick_toml), ("camera.exposure_s=0.0139",), folder, after_s=random.uniform(0.3, 1.5))
        assert left.wrong == 0
        assert 0 <= left.missing < left.acquired
        kept = len(Recording(folder))
        assert recover(folder).frames == kept
        assert_made_again(Recording(folder))
