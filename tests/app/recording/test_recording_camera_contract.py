"""Device contracts for the devices of a recording, also when its disk is removed."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from support.camera_contract import CameraContract, CameraFaultContract, CameraFaults
from support.light_contract import LightContract
from support.recordings import edit_line, record
from support.records import frame_file
from support.stage_contract import StageContract

from app.recording.playback_devices import RecordedCamera, RecordedLight, RecordedStage
from app.recording.reader import Recording
from drivers.interface import BadValue, Camera, LightSource, Stage
from simulated_devices.clock import ManualClock

FRAMES = 14
EXPOSURE_S = 0.02
LIGHT_A = 0.25


class YieldingClock(ManualClock):
    """Clock that jumps and yields to other threads."""

    def sleep(self, duration_s: float) -> None:
        super().sleep(duration_s)
        time.sleep(0.001)


def opened(folder: Path, *, is_lit: bool = True, is_sample_in: bool = True) -> RecordedCamera:
    clock = YieldingClock()
    camera = RecordedCamera(Recording(folder), range(FRAMES), pace="own", repeat=True, clock=clock)
    camera.see(is_lit=is_lit, is_sample_in=is_sample_in)
    return camera


@pytest.fixture(scope="module")
def folder(small_toml: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Frames that came one exposure after another."""
    recording = record(small_toml, tmp_path_factory.mktemp("recording") / "run", frames=FRAMES)
    for index in range(FRAMES):
        edit_line(recording, index, host_time_s=1000 + index * EXPOSURE_S, lost=0, light_current_a=LIGHT_A)
    return recording.folder


@pytest.fixture
def camera(reopen: Callable[[], RecordedCamera]) -> Iterator[RecordedCamera]:
    with reopen() as camera:
        yield camera


class TestRecordedCamera(CameraContract):
    @pytest.fixture(params=["frames", "reference", "dark"])
    def reopen(self, request: pytest.FixtureRequest, folder: Path) -> Callable[[], Camera]:
        return lambda: opened(folder, is_lit=request.param != "dark", is_sample_in=request.param == "frames")


class Stick:
    """A copy of a recording without a dark, on a removable disk."""

    def __init__(self, recording: Path, folder: Path) -> None:
        self.path, self._away = folder / "run", folder / "elsewhere" / "run"  # beside it, it would be found
        self._away.parent.mkdir()
        shutil.copytree(recording, self.path)
        frame_file(self.path, 0)  # each frame its own, to damage one
        (self.path / "calibrations/0/dark.npz").unlink()
        self._camera: RecordedCamera | None = None

    def open(self) -> RecordedCamera:
        self._camera = opened(self.path)
        return self._camera

    def unplug(self) -> None:
        self.path.rename(self._away)

    def plug_in(self) -> None:
        self._away.rename(self.path)

    def stall(self) -> None:
        """Switch the light off: there is no dark."""
        assert self._camera is not None
        self._camera.see(is_lit=False, is_sample_in=True)

    def lose_frames(self, count: int) -> None:
        """Damage the next frames: one is cut short, the others are missing."""
        assert self._camera is not None
        first = self._camera.next_frame
        for index in range(first, first + count):
            chunk = frame_file(self.path, index)
            if index == first:
                chunk.write_bytes(chunk.read_bytes()[:1001])
            else:
                chunk.unlink()

    def refuse_next(self) -> None:
        """Do nothing: only the recorded setting is ever accepted."""


class TestRecordedCameraOnAStick(CameraFaultContract):
    @pytest.fixture
    def faults(self, folder: Path, tmp_path: Path) -> Stick:
        return Stick(folder, tmp_path)

    @pytest.fixture
    def reopen(self, faults: Stick) -> Callable[[], Camera]:
        return faults.open

    def test_refused_exposure_changes_nothing(self, camera: Camera, faults: CameraFaults) -> None:
        """No setting is accepted at one time and refused at another."""
        before_s = camera.exposure_s
        for exposure_s in (0.5 * before_s, 2 * before_s):
            faults.refuse_next()
            with pytest.raises(BadValue):
                camera.set_exposure(exposure_s)
        assert camera.exposure_s == before_s
        camera.start()
        assert camera.read(1.0).exposure_s == before_s


@pytest.fixture
def dark_camera(folder: Path) -> RecordedCamera:
    return opened(folder, is_lit=False, is_sample_in=False)


class TestRecordedLight(LightContract):
    @pytest.fixture
    def reopen(self, dark_camera: RecordedCamera) -> Callable[[], LightSource]:
        return lambda: RecordedLight(dark_camera)

    @pytest.fixture
    def light(self, reopen: Callable[[], LightSource]) -> Iterator[LightSource]:
        with reopen() as light:
            yield light

    def test_light_current_is_that_of_the_frames(self, light: LightSource) -> None:
        assert light.current_a == LIGHT_A
        with pytest.raises(BadValue):
            light.set_current(0.3)


class TestRecordedStage(StageContract):
    @pytest.fixture
    def stage(self, dark_camera: RecordedCamera) -> Iterator[Stage]:
        with RecordedStage(dark_camera, "square") as stage:
            yield stage
