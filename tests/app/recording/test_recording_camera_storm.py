"""Random commands to a recorded camera while its folder is damaged, removed and restored."""

from __future__ import annotations

import atexit
import functools
import shutil
import tempfile
from pathlib import Path
from typing import Any

from conftest import SMALL_TOML
from hypothesis import strategies as st
from hypothesis.stateful import precondition, rule
from support.camera_storm import CameraStorm
from support.recordings import record
from support.storm import storm_settings

from app.errors import InputError
from app.recording.reader import Recording
from app.recording.recorded_devices import RecordedCamera
from drivers.interface import Camera, Disconnected
from simulated_devices.clock import ManualClock

FRAMES = 6


@functools.cache
def original() -> Path:
    """Make one recording for all sequences; it is never changed."""
    folder = Path(tempfile.mkdtemp())
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    toml = folder / "small.toml"
    toml.write_text(SMALL_TOML)
    return record(toml, folder / "run", frames=FRAMES).folder


class Folder:
    """A copy that can be damaged."""

    def __init__(self) -> None:
        self._keeper = tempfile.TemporaryDirectory()
        self.path, self._away = Path(self._keeper.name) / "run", Path(self._keeper.name) / "elsewhere" / "run"
        self.close = self._keeper.cleanup
        self.clock = ManualClock()
        self.restore()

    def vanish(self) -> None:
        if self.path.exists():
            self._away.parent.mkdir(exist_ok=True)  # beside its old place it would be found again
            self.path.rename(self._away)

    def restore(self) -> None:
        for folder in (self.path, self._away):
            shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(original(), self.path)

    def truncate(self, index: int) -> None:
        """Cut one frame in half."""
        chunk = self.path / f"frames.zarr/0/c/{index}/0/0"
        if chunk.exists():
            chunk.write_bytes(chunk.read_bytes()[:100])

    def spoil_calibration(self) -> None:
        reference = self.path / "calibrations/0/reference.npz"
        if reference.exists():
            reference.write_bytes(b"nothing")


class RecordedCameraStorm(CameraStorm):
    def make(self) -> Folder:
        return Folder()

    def open(self) -> Camera:
        clock = self.device.clock
        try:
            recording = Recording(self.device.path)
            return RecordedCamera(recording, range(FRAMES), pace="own", repeat=True, clock=clock)
        except InputError as error:  # there is no camera yet
            raise Disconnected(str(error)) from error

    def now(self) -> float:
        return float(self.device.clock.now())

    def faults(self) -> st.SearchStrategy[Any]:
        return st.sampled_from(["vanish", "spoil_calibration"]) | st.integers(0, FRAMES - 1)

    def happen(self, fault: Any) -> None:
        if isinstance(fault, int):
            self.device.truncate(fault)
        else:
            getattr(self.device, fault)()

    def recover(self) -> None:
        self.device.restore()

    def teardown(self) -> None:
        super().teardown()
        if isinstance(self.device, Folder):
            self.device.close()

    @precondition(lambda self: self.camera is not None)
    @rule(is_lit=st.booleans(), is_sample_in=st.booleans())
    def see(self, *, is_lit: bool, is_sample_in: bool) -> None:
        assert isinstance(self.camera, RecordedCamera)
        self.camera.see(is_lit=is_lit, is_sample_in=is_sample_in)


TestRecordedCamera = RecordedCameraStorm.TestCase
TestRecordedCamera.settings = storm_settings()
