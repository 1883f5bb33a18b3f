"""A recording in place of devices: its own frames, pace, losses and calibrations, and nothing that could be changed."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from recordings import edit_line, record
from test_cli import run

from app.acquisition import Acquisition
from app.calibration import one_blas_thread
from app.config import write_bench
from app.errors import InputError
from app.measurement import Counts, Measurement
from app.recording.reader import Recording
from app.recording.record import Record
from app.recording.run_writer import RunWriter
from app.replay.devices import RecordedCamera, recorded_devices
from app.replay.player import Player
from drivers.interface import BadValue, DeviceTimeout, Disconnected, Frame, Unsupported, WrongState
from reconstruction.pipeline import ReconstructionSettings
from reconstruction.wavefront import rms

FRAMES = 6
GAPS_S = (0.05, 0.05, 30.0, 0.1, 0.05)  # between arrivals


class Clock:
    """Time that passes only when somebody sleeps."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def now(self) -> float:
        return self.now_s

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds


@pytest.fixture(scope="module")
def recording(small_toml: Path, tmp_path_factory: pytest.TempPathFactory) -> Recording:
    recording = record(small_toml, tmp_path_factory.mktemp("recording") / "run", frames=FRAMES)
    host_s = 1000.0
    for index, gap_s in enumerate((0.0, *GAPS_S)):
        host_s += gap_s
        edit_line(recording, index, host_time_s=host_s, lost=2 if index == 3 else 0, exposure_s=0.02)
    return Recording(recording.folder)


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def camera(recording: Recording, clock: Clock) -> Iterator[RecordedCamera]:
    with RecordedCamera(recording, range(FRAMES), now=clock.now, sleep=clock.sleep) as camera:
        yield camera


def read(camera: RecordedCamera) -> Frame:
    return camera.read(10.0)


def test_frames_come_at_their_own_pace_and_again_after_the_last(
    camera: RecordedCamera, recording: Recording, clock: Clock
) -> None:
    camera.start()
    came: list[tuple[float, Frame]] = []
    for _ in range(2 * FRAMES):
        came.append((clock.now_s, read(camera)))
        came[-1] = (clock.now_s, came[-1][1])
    for at, (_, frame) in enumerate(came):
        np.testing.assert_array_equal(frame.pixels, recording.pixels(at % FRAMES))
        assert (frame.exposure_s, frame.em_gain) == (0.02, 8.0)
    # The half minute in which nothing was recorded is made a second; the losses are there again.
    steps_s = np.diff([time_s for time_s, _ in came])
    once_s = [0.05, 0.05, 1.02, 0.1, 0.05]
    np.testing.assert_allclose(steps_s, [*once_s, 0.02, *once_s])
    assert [frame.index for _, frame in came] == [0, 1, 2, 5, 6, 7, 8, 9, 10, 13, 14, 15]
    np.testing.assert_allclose([frame.host_time_s for _, frame in came], [time_s for time_s, _ in came])


def test_it_goes_on_where_it_was_stopped(camera: RecordedCamera, recording: Recording) -> None:
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


def test_no_frame_comes_before_its_time(camera: RecordedCamera, clock: Clock) -> None:
    camera.start()
    before_s = clock.now_s
    with pytest.raises(DeviceTimeout):
        camera.read(0.0)
    assert clock.now_s == before_s
    with pytest.raises(DeviceTimeout):
        camera.read(0.015)
    assert clock.now_s == pytest.approx(before_s + 0.015)
    camera.read(0.01)
    assert clock.now_s == pytest.approx(before_s + 0.02)


def test_who_was_away_misses_little(camera: RecordedCamera, clock: Clock) -> None:
    """After an hour the recording has waited: it is a second behind, not an hour."""
    camera.start()
    read(camera)
    clock.sleep(3600)
    read(camera)
    before_s = clock.now_s
    for _ in range(FRAMES):
        read(camera)
    assert clock.now_s > before_s


def test_nothing_can_be_changed(recording: Recording) -> None:
    with recorded_devices(recording, range(FRAMES)) as devices:
        camera, light, stage = devices.camera, devices.light, devices.stage
        assert camera.name == "recording run"
        allowed = camera.capabilities
        assert (allowed.rows, allowed.columns, allowed.amplifiers) == (172, 240, (camera.amplifier,))
        assert allowed.full_scale == recording.calibration(0).full_scale
        with pytest.raises(BadValue, match=r"exposure_s = 0.5 is outside 0.02"):
            camera.set_exposure(0.5)
        assert light.is_on
        light.set_on(True)
        with pytest.raises(Unsupported, match="its light stays as it was"):
            light.set_on(False)
        stage.set_sample_in(True)
        with pytest.raises(Unsupported, match="its sample stays"):
            stage.set_sample_in(False)
    with pytest.raises(WrongState):
        camera.start()


def test_a_damaged_frame_is_a_lost_device(recording: Recording, clock: Clock, monkeypatch: pytest.MonkeyPatch) -> None:
    def damaged(_recording: Recording, _index: int) -> None:
        raise InputError("frame 0 is damaged")

    with RecordedCamera(recording, range(FRAMES), now=clock.now, sleep=clock.sleep) as camera:
        camera.start()
        monkeypatch.setattr(Recording, "frame", damaged)
        with pytest.raises(Disconnected, match="frame 0 is damaged"):
            read(camera)


@pytest.fixture(scope="module")
def changing(recording: Recording, tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """The same frames, the second half with fewer pupil modes."""
    folder = tmp_path_factory.mktemp("recording") / "changing"
    kept = recording.calibration(0)
    fewer = replace(kept, bench=replace(kept.bench, reconstruction=ReconstructionSettings(pupil_modes=6)))
    writer = RunWriter(folder, {"command": "live", "bench": write_bench(kept.bench)})
    for index in range(FRAMES):
        calibration = kept if index < FRAMES // 2 else fewer
        with one_blas_thread():
            wavefront = calibration.reconstructor()(recording.pixels(index))
        frame = replace(recording.frame(index), host_time_s=0.2 * index)
        writer.write(Record.of(Measurement(frame, wavefront, "", Counts(), 0, 0, calibration=calibration), 0))
    writer.finish("", acquired=FRAMES, facts={})
    writer.close()
    return Recording(folder)


def test_each_frame_is_shown_by_its_own_calibration(changing: Recording) -> None:
    """Also when they come round again; nothing is taken anew."""
    player = Player(changing.folder)
    seen: list[Measurement] = []
    acquisition = Acquisition(player.bench, player.open_devices, (player.take, seen.append))
    acquisition.start()
    try:
        for step in player.begin(acquisition):
            step.result(30)
        deadline_s = time.monotonic() + 60
        while len(seen) < 2 * FRAMES:
            assert time.monotonic() < deadline_s
            assert acquisition.is_alive, acquisition.failure
            time.sleep(0.01)
        assert acquisition.status is not None
        assert (acquisition.status.dark, acquisition.status.reference, acquisition.status.warning) == (
            "good",
            "good",
            "",
        )
    finally:
        acquisition.close()
    which = [
        next(index for index in range(FRAMES) if np.array_equal(measurement.frame.pixels, changing.pixels(index)))
        for measurement in seen
    ]
    assert which[: 2 * FRAMES] == [*range(FRAMES), *range(FRAMES)]
    for index, measurement in zip(which, seen, strict=True):
        assert measurement.calibration is not None
        modes = measurement.calibration.bench.reconstruction.pupil_modes
        assert modes == changing.calibration(0 if index < FRAMES // 2 else 1).bench.reconstruction.pupil_modes
        if measurement.wavefront is not None:  # else it was passed over
            expected = changing.calibration(0 if index < FRAMES // 2 else 1).reconstructor()(changing.pixels(index))
            np.testing.assert_allclose(rms(measurement.wavefront.views), rms(expected.views), rtol=1e-3)


def test_other_settings_show_something_else(changing: Recording) -> None:
    player = Player(changing.folder, settings=("reconstruction.method=zonal",), frames="1:3")
    assert player.bench.reconstruction.method == "zonal"


def test_frames_without_a_calibration_cannot_be_played(changing: Recording, tmp_path: Path) -> None:
    frame = changing.frame(0)
    writer = RunWriter(tmp_path / "run", {"command": "live", "bench": write_bench(changing.bench)})
    writer.write(Record.of(Measurement(frame, None, "no reference yet", Counts(), 0, 0), 0))
    writer.finish("", acquired=1, facts={})
    writer.close()
    with pytest.raises(InputError, match="have no calibration"):
        Player(tmp_path / "run")


def test_the_window_shows_it(changing: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By the command, unseen; what it leaves is the wavefront of one of the frames."""
    out = tmp_path / "out"
    arguments = ("--replay", changing.folder, "--frames", "0:2", "--seconds", "0.5", "--out", out)
    assert run(monkeypatch, "live", *arguments) == 0
    assert (out / "window.png").stat().st_size > 10_000
    expected = [rms(changing.calibration(0).reconstructor()(changing.pixels(index)).views) for index in (0, 1)]
    with xr.open_dataset(out / "result.nc") as shown:
        assert any(np.allclose(shown["rms"], each, rtol=1e-3) for each in expected)


def test_frames_of_no_recording_are_a_mistake(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, "live", "--frames", "0:2") == 2
    assert "give --replay RECORDING" in capsys.readouterr().err
