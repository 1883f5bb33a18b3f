"""A recording in place of the devices of a bench: camera, light and stage."""

from contextlib import ExitStack

from app.bench.device_kinds import Pace
from app.recording.reader import Recording
from app.recording.recorded_camera import RecordedCamera
from drivers.interface import Devices, LightSource, Range, Stage


def recorded_devices(recording: Recording, frames: range, *, pace: Pace = "own", repeat: bool = True) -> Devices:
    """Open the devices that play some frames of a recording while the light is on and the sample in."""
    with ExitStack() as stack:
        camera = stack.enter_context(RecordedCamera(recording, frames, pace=pace, repeat=repeat))
        stage = stack.enter_context(RecordedStage(camera, recording.bench.simulation.source.mask))
        light = stack.enter_context(RecordedLight(camera))
        return Devices(camera, light, stage, stack.pop_all())


class RecordedLight(LightSource):
    """Light of a recording; its current is that of the frame that was read last."""

    name = "as recorded"

    def __init__(self, camera: RecordedCamera) -> None:
        super().__init__()
        self._camera = camera
        self._begin()

    def _read_range(self) -> Range:
        return Range(self._read_current(), self._read_current())

    def _read_current(self) -> float:
        return self._camera.line.light_current_a or 0.0

    def _set_current(self, current_a: float) -> float:
        return current_a  # no other is allowed

    def _is_lit(self) -> bool:
        return self._camera.is_lit

    def _switch(self, *, on: bool) -> None:
        self._camera.see(is_lit=on, is_sample_in=self._camera.is_sample_in)

    def _close(self) -> None:
        pass


class RecordedStage(Stage):
    """Stage of a recording: with the sample out, the camera sees the reference."""

    name = "as recorded"

    def __init__(self, camera: RecordedCamera, mask: str) -> None:
        super().__init__(mask)
        self._camera = camera

    def _is_sample_in(self) -> bool:
        return self._camera.is_sample_in

    def _set_sample_in(self, *, sample_in: bool) -> None:
        self._camera.see(is_lit=self._camera.is_lit, is_sample_in=sample_in)

    def _close(self) -> None:
        pass
