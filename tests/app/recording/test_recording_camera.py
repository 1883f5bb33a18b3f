"""Camera that plays a recording: frames, pace, losses, dark and reference."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.recorded_camera import EXPOSURE_S, FRAMES, copied, steady_recording
from support.recordings import edit_line
from support.records import frame_file

from app.bench.config import write_bench
from app.bench.device_kinds import Pace
from app.measurement.averages import Average, average, take_dark, take_reference
from app.measurement.calibration import Calibration
from app.measurement.measurement import Measurement
from app.measurement.routines import NO_CALLBACKS
from app.recording.playback_devices import AveragedFrames, RecordedCamera, playback_devices
from app.recording.reader import Recording
from app.recording.writer import Record, RecordingWriter
from drivers.interface import Camera, DeviceTimeout, Disconnected, Frame, FrameLost, Range, WrongState
from simulated_devices.clock import ManualClock

GAPS_S = (0.05, 0.05, 30.0, 0.1, 0.05)  # between arrivals
PLAYED_S = (0.05, 0.05, 1.02, 0.1, 0.05)  # the long gap is shortened to a second
WITH_LOSSES = (0, 1, 2, 5, 6, 7)  # two were lost before the fourth


@pytest.fixture(scope="module")
def steady(small_toml: Path, tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return steady_recording(small_toml, tmp_path_factory.mktemp("recording") / "run")


@pytest.fixture(scope="module")
def recording(steady: Recording, tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """The same frames with gaps and losses."""
    recording = copied(steady, tmp_path_factory.mktemp("gaps") / "run")
    host_s = 1000.0
    for index, gap_s in enumerate((0.0, *GAPS_S)):
        host_s += gap_s
        edit_line(recording, index, host_time_s=host_s, lost=2 if index == 3 else 0)
    return Recording(recording.folder)


@pytest.fixture
def clock() -> ManualClock:
    return ManualClock()


@pytest.fixture
def camera(recording: Recording, clock: ManualClock) -> Iterator[RecordedCamera]:
    with player(recording, clock) as camera:
        yield camera


def player(
    recording: Recording, clock: ManualClock, *, pace: Pace = "own", repeat: bool = True, shows: str = "frames"
) -> RecordedCamera:
    frames = range(len(recording))
    camera = RecordedCamera(recording, frames, pace=pace, repeat=repeat, clock=clock)
    camera.see(is_lit=shows != "dark", is_sample_in=shows == "frames")
    return camera


def read(camera: Camera) -> Frame:
    return camera.read(10.0)


def test_frames_play_at_recorded_pace_and_repeat(
    camera: RecordedCamera, recording: Recording, clock: ManualClock
) -> None:
    camera.start()
    came_s, frames = [], []
    for _ in range(2 * FRAMES):
        frames.append(read(camera))
        came_s.append(clock.now())
    for at, frame in enumerate(frames):
        np.testing.assert_array_equal(frame.pixels, recording.pixels(at % FRAMES))
        assert (frame.exposure_s, frame.em_gain) == (EXPOSURE_S, 8.0)
    np.testing.assert_allclose(np.diff(came_s), [*PLAYED_S, EXPOSURE_S, *PLAYED_S])
    assert [frame.index for frame in frames] == [*WITH_LOSSES, *(8 + index for index in WITH_LOSSES)]
    np.testing.assert_allclose([frame.host_time_s for frame in frames], came_s)
    np.testing.assert_allclose([frame.camera_time_s for frame in frames], came_s)


def test_double_speed_halves_the_gaps(camera: RecordedCamera, clock: ManualClock) -> None:
    camera.speed = 2.0
    camera.start()
    came_s = [(read(camera), clock.now())[1] for _ in range(FRAMES)]
    np.testing.assert_allclose(np.diff(came_s), np.array(PLAYED_S) / 2)


def test_loss_before_the_first_frame_is_not_repeated(steady: Recording, clock: ManualClock, tmp_path: Path) -> None:
    edited = copied(steady, tmp_path / "run")
    edit_line(edited, 0, lost=3)
    with player(Recording(edited.folder), clock) as camera:
        camera.start()
        assert [read(camera).index for _ in range(FRAMES + 2)] == list(range(FRAMES + 2))


def test_fastest_pace_returns_frames_as_they_are_read(recording: Recording, clock: ManualClock) -> None:
    """No frame waits in the camera, so that a slow reader skips none."""
    with player(recording, clock, pace="fastest", repeat=False) as camera:
        camera.start()
        frames = []
        for index in range(FRAMES):
            clock.sleep(5.0 * index)
            before_s = clock.now()
            with pytest.raises(DeviceTimeout):
                camera.read(0.0)
            frames.append(camera.read(0.1))
            assert clock.now() == before_s
    for index, frame in enumerate(frames):
        np.testing.assert_array_equal(frame.pixels, recording.pixels(index))
    assert [frame.index for frame in frames] == [*WITH_LOSSES]
    np.testing.assert_allclose(np.diff([frame.camera_time_s for frame in frames]), PLAYED_S)


@pytest.mark.parametrize("pace", ["own", "fastest"])
def test_read_after_the_last_frame_times_out_with_the_reason(
    recording: Recording, clock: ManualClock, pace: Pace
) -> None:
    with player(recording, clock, pace=pace, repeat=False) as camera:
        camera.start()
        for _ in range(FRAMES):
            read(camera)
        for _ in range(2):
            before_s = clock.now()
            with pytest.raises(DeviceTimeout, match=f"recording run has ended: all {FRAMES} frames were played"):
                camera.read(0.1)
            assert clock.now() == pytest.approx(before_s + 0.1)
            camera.stop()
            camera.start()
        camera.see(is_lit=False, is_sample_in=True)
        assert read(camera).index == 0  # its dark still comes


def test_restart_continues_at_the_same_frame(camera: RecordedCamera, recording: Recording) -> None:
    camera.start()
    read(camera)
    read(camera)
    camera.stop()
    with pytest.raises(WrongState):
        read(camera)
    camera.start()
    frame = read(camera)
    assert frame.index == 0
    np.testing.assert_array_equal(frame.pixels, recording.pixels(2))


def test_read_before_the_next_frame_times_out(camera: RecordedCamera, clock: ManualClock) -> None:
    camera.start()
    before_s = clock.now()
    with pytest.raises(DeviceTimeout):
        camera.read(0.0)
    assert clock.now() == before_s
    with pytest.raises(DeviceTimeout):
        camera.read(0.015)
    assert clock.now() == pytest.approx(before_s + 0.015)
    camera.read(0.01)
    assert clock.now() == pytest.approx(before_s + 0.02)


def test_late_reader_misses_at_most_a_second(camera: RecordedCamera, clock: ManualClock) -> None:
    """After an hour without a read, the recording is a second behind."""
    camera.start()
    read(camera)
    clock.sleep(3600)
    read(camera)
    before_s = clock.now()
    for _ in range(FRAMES):
        read(camera)
    assert clock.now() > before_s


def test_dark_and_reference_have_the_recorded_averages(recording: Recording) -> None:
    """Reading them does not advance the recording."""
    kept = recording.calibration(0)
    assert kept.dark is not None
    with playback_devices(recording, range(FRAMES), pace="fastest", repeat=True) as devices:
        assert not devices.light.is_on
        assert not devices.stage.is_sample_in
        taken = {"dark": take_dark(devices, kept.dark.frames, NO_CALLBACKS)}
        taken["reference"] = take_reference(devices, kept.reference.frames, NO_CALLBACKS)
        devices.light.set_on(True)
        devices.stage.set_sample_in(True)
        devices.camera.start()
        np.testing.assert_array_equal(devices.camera.read(1.0).pixels, recording.pixels(0))
    for what, was in (("dark", kept.dark), ("reference", kept.reference)):
        now = taken[what]
        np.testing.assert_array_equal(now.mean, was.mean, err_msg=what)
        assert now.variance.mean() == pytest.approx(was.variance.mean(), rel=0.02), what
        assert (now.frames, now.exposure_s, now.em_gain, now.amplifier) == (
            was.frames,
            was.exposure_s,
            was.em_gain,
            was.amplifier,
        )


@pytest.mark.parametrize("frames", [1, 2, 4, 5, 20])
@pytest.mark.parametrize(
    ("level", "spread", "tolerance"),
    [(500.3, 6.0, 0.02), (3000.0, 50.0, 0.02), (0.4, 0.6, 0.3), (65534.0, 3.0, 0.6), (65535.0, 0.0, 0.0)],
)
def test_averaged_frames_reproduce_mean_and_variance(
    frames: int, level: float, spread: float, tolerance: float
) -> None:
    """At the ends of the scale, where the variance has no room, the mean is still exact."""
    rng = np.random.default_rng(frames)
    seen = np.clip(np.rint(rng.normal(level, spread, (frames, 60, 70))), 0, 65535)
    variance = seen.var(axis=0, ddof=min(frames - 1, 1)).astype(np.float32)
    kept = Average(seen.mean(axis=0).astype(np.float32), variance, frames, EXPOSURE_S, 1.0, "em")
    made = AveragedFrames(kept, 65535)
    for first in (0, 3 * frames, 7):  # starting anywhere
        shown = np.array([made.pixels(first + index) for index in range(frames)], np.float64)
        np.testing.assert_array_equal(shown.mean(axis=0).astype(np.float32), kept.mean)
        scatter = shown.var(axis=0, ddof=min(frames - 1, 1)).mean()
        assert scatter == pytest.approx(variance.mean(), rel=tolerance, abs=1e-6)


def test_rounding_is_a_part_of_the_variance() -> None:
    """Levels of 500.5 +- 0.5 counts at random have 0.25 counts^2 already; rounding adds nothing to 0.6."""
    random = np.random.default_rng(3)
    mean = random.uniform(500, 501, (90, 80)).astype(np.float32)
    made = AveragedFrames(Average(mean, np.full((90, 80), 0.6, np.float32), 20, 0.02, 1.0, "em"), 65535)
    shown = np.array([made.pixels(index) for index in range(20)], np.float64)
    assert shown.var(axis=0, ddof=1).mean() == pytest.approx(0.6, rel=0.1)


def test_pixels_alternate_independently() -> None:
    kept = Average(np.full((90, 80), 500.5, np.float32), np.full((90, 80), 36, np.float32), 20, 0.02, 1.0, "em")
    made = AveragedFrames(kept, 65535)
    levels = [made.pixels(index).mean() for index in range(20)]
    assert np.std(levels) < 3 * 6 / np.sqrt(90 * 80)


@pytest.fixture(scope="module")
def two_references(steady: Recording, tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """A recording with a longer reference, without a dark, in its second half."""
    kept = steady.calibration(0)
    longer = replace(kept.reference, mean=kept.reference.mean + 100, exposure_s=0.04)
    return written(steady, tmp_path_factory.mktemp("two") / "run", (kept, replace(kept, reference=longer, dark=None)))


def written(source: Recording, folder: Path, calibrations: tuple[Calibration | None, ...]) -> Recording:
    """Copy a recording, dividing its frames among some calibrations."""
    with closing(RecordingWriter(folder, {"command": "live", "bench": write_bench(source.bench)})) as writer:
        for index in range(FRAMES):
            calibration = calibrations[index * len(calibrations) // FRAMES]
            frame = replace(source.frame(index), exposure_s=0.02 if index < FRAMES // 2 else 0.04)
            writer.write(Record.of(Measurement(frame, None, "", calibration=calibration)))
        writer.finish("", acquired=FRAMES, facts={})
    return Recording(folder)


def test_dark_and_reference_are_those_of_the_next_frame(two_references: Recording, clock: ManualClock) -> None:
    with player(two_references, clock, pace="fastest") as camera:
        for half, exposure_s in enumerate((0.02, 0.04)):
            kept = two_references.calibration(half)
            camera.see(is_lit=True, is_sample_in=False)
            shown = average(camera, kept.reference.frames, NO_CALLBACKS)
            np.testing.assert_array_equal(shown.mean, kept.reference.mean)
            assert (shown.exposure_s, camera.capabilities.exposure_range_s.maximum) == (exposure_s, exposure_s)
            camera.see(is_lit=True, is_sample_in=True)
            assert [read(camera).exposure_s for _ in range(FRAMES // 2)] == [exposure_s] * (FRAMES // 2)
            assert camera.exposure_s == exposure_s
            camera.stop()


def test_allowed_exposure_follows_the_view(two_references: Recording, clock: ManualClock) -> None:
    with player(two_references, clock, pace="fastest") as camera:
        camera.start()
        for exposure_s in (0.02, 0.02, 0.02, 0.04, 0.04):
            read(camera)
            assert camera.capabilities.exposure_range_s == Range(exposure_s, exposure_s)
        camera.stop()
    with player(two_references, clock, pace="fastest") as camera:
        camera.start()
        for _ in range(FRAMES // 2):
            read(camera)
        for is_sample_in, exposure_s in ((True, 0.02), (False, 0.04), (True, 0.02)):
            camera.see(is_lit=True, is_sample_in=is_sample_in)
            assert camera.exposure_s == exposure_s
            assert camera.capabilities.exposure_range_s == Range(exposure_s, exposure_s)


def test_missing_dark_or_reference_times_out_with_the_reason(
    steady: Recording, clock: ManualClock, tmp_path: Path
) -> None:
    kept = steady.calibration(0)
    without_dark = written(steady, tmp_path / "bright", (replace(kept, dark=None),))
    without_any = written(steady, tmp_path / "bare", (None,))
    for recording, shows, sentence in (
        (without_dark, "dark", "recording bright holds no dark"),
        (without_any, "dark", "recording bare holds no dark"),
        (without_any, "reference", "recording bare holds no reference"),
    ):
        with player(recording, clock, shows=shows) as camera:
            camera.start()
            with pytest.raises(DeviceTimeout, match=sentence):
                read(camera)
            camera.see(is_lit=True, is_sample_in=True)
            np.testing.assert_array_equal(read(camera).pixels, steady.pixels(0))


def test_damaged_frame_counts_as_lost(steady: Recording, clock: ManualClock, tmp_path: Path) -> None:
    recording = copied(steady, tmp_path / "run")
    chunk = frame_file(recording.folder, 1)
    chunk.write_bytes(chunk.read_bytes()[:1000])
    with player(recording, clock) as camera:
        camera.start()
        read(camera)
        with pytest.raises(FrameLost, match="is damaged: 1000 bytes instead of"):
            read(camera)
        frame = read(camera)
        assert frame.index == 2
        assert clock.now() == pytest.approx(3 * EXPOSURE_S)
        np.testing.assert_array_equal(frame.pixels, steady.pixels(2))


def test_recording_with_damaged_first_frame_opens(steady: Recording, tmp_path: Path) -> None:
    recording = copied(steady, tmp_path / "run")
    frame_file(recording.folder, 0).unlink()
    with player(recording, ManualClock(), pace="fastest") as camera:
        camera.start()
        with pytest.raises(FrameLost, match="the pixels of frame 0 are missing"):
            read(camera)
        frame = read(camera)
        assert frame.index == 1
        np.testing.assert_array_equal(frame.pixels, steady.pixels(1))


def test_damaged_calibration_counts_as_disconnected(steady: Recording, clock: ManualClock, tmp_path: Path) -> None:
    recording = copied(steady, tmp_path / "run")
    (recording.folder / "calibrations" / "0" / "reference.npz").write_bytes(b"PK")
    with player(recording, clock, shows="reference") as camera:
        with pytest.raises(Disconnected, match=r"reference\.npz: cannot be read"):
            camera.start()
        assert camera.state == "lost"


def test_unfinished_recording_plays_its_frames(steady: Recording, clock: ManualClock, tmp_path: Path) -> None:
    """The program died in the middle of a line."""
    folder = copied(steady, tmp_path / "run").folder
    facts = json.loads((folder / "run.json").read_text())
    (folder / "run.json").write_text(json.dumps({**facts, "complete": False}))
    lines = (folder / "frames.jsonl").read_bytes()
    (folder / "frames.jsonl").write_bytes(lines[:-20])
    with player(Recording(folder), clock, repeat=False) as camera:
        camera.start()
        for index in range(FRAMES - 1):
            np.testing.assert_array_equal(read(camera).pixels, steady.pixels(index))
        with pytest.raises(DeviceTimeout, match="has ended"):
            read(camera)
