"""A recording in place of the devices that it was made with: a camera that plays it, a light and a stage that stay."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace

from app.errors import InputError
from app.recording.reader import Recording
from drivers.interface import (
    Camera,
    CameraCapabilities,
    Devices,
    DeviceTimeout,
    Disconnected,
    Frame,
    LightSource,
    Range,
    Stage,
    Unsupported,
)

_LONGEST_GAP_S = 1.0  # beyond an exposure, in which nothing was recorded: as while a new reference was taken
_LATE_S = 1.0  # when nobody has read for so long, the recording waits


def recorded_devices(recording: Recording, frames: range) -> Devices:
    """The devices that show some frames of a recording, again and again."""
    with ExitStack() as stack:
        camera = stack.enter_context(RecordedCamera(recording, frames))
        stage = stack.enter_context(RecordedStage(recording))
        light = stack.enter_context(RecordedLight(camera))
        return Devices(camera, light, stage, stack.pop_all())


class RecordedCamera(Camera):
    """Plays frames at the pace at which they arrived, and from the first again after the last.

    When it is stopped and started it goes on where it was. Frames that were lost are lost again.
    """

    def __init__(
        self,
        recording: Recording,
        frames: range,
        *,
        now: Callable[[], float] = time.perf_counter,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        super().__init__()
        self._recording, self._frames, self._now, self._sleep = recording, frames, now, sleep
        self._position = 0  # among `frames`, of the next one
        self._runs = False
        self._count = 0  # since the start, lost ones included: the index of the next frame
        self._due_s = 0.0  # when the next one comes
        self.line = recording.line(frames[0])  # of the frame that was read last, at first of the first

    @property
    def name(self) -> str:
        """Which recording it is."""
        return f"recording {self._recording.folder.name}"

    @property
    def next_frame(self) -> int:
        """The index in the recording of the frame that comes next."""
        return self._frames[self._position]

    def _read_capabilities(self) -> CameraCapabilities:
        rows, columns = self._recording.pixels(self._frames[0]).shape
        line, number = self.line, self.line.calibration
        calibration = None if number is None else self._recording.calibration(number)
        return CameraCapabilities(
            rows=rows,
            columns=columns,
            pixel_pitch_m=self._recording.bench.sensor.pixel_pitch_m,
            full_scale=65535 if calibration is None else int(calibration.full_scale),
            exposure_range_s=Range(line.exposure_s, line.exposure_s),
            em_gain_range=Range(line.em_gain, line.em_gain),
            amplifiers=("as recorded" if calibration is None else calibration.reference.amplifier,),
        )

    def _is_running(self) -> bool:
        return self._runs

    def _start(self) -> None:
        self._runs, self._count = True, 0
        self._due_s = self._now() + self._recording.line(self.next_frame).exposure_s

    def _stop(self) -> None:
        self._runs = False

    def _read(self, timeout_s: float) -> Frame:
        wait_s = self._due_s - self._now()
        if wait_s > timeout_s:
            self._sleep(timeout_s)
            raise DeviceTimeout("the recording has no frame at this moment")
        self._sleep(max(wait_s, 0.0))
        try:
            frame = self._recording.frame(self.next_frame)
            self.line = self._recording.line(self.next_frame)
            self._allowed = None  # other frames may have been taken otherwise
            played = replace(frame, index=self._count, camera_time_s=self._due_s, host_time_s=self._now())
            self._go_on()
        except InputError as error:
            raise Disconnected(str(error)) from error
        return played

    def _go_on(self) -> None:
        """Find out which frame comes next, and when."""
        self._position = (self._position + 1) % len(self._frames)
        after = self._recording.line(self.next_frame)
        gap_s, exposure_s = after.host_time_s - self.line.host_time_s, after.exposure_s
        if self._position == 0:
            gap_s = exposure_s
        self._count += 1 + (after.lost if self._position else 0)
        self._due_s = max(self._due_s, self._now() - _LATE_S) + min(max(gap_s, 0.0), exposure_s + _LONGEST_GAP_S)

    def _read_exposure(self) -> float:
        return self.line.exposure_s

    def _set_exposure(self, exposure_s: float) -> float:
        return exposure_s  # no other is allowed

    def _read_em_gain(self) -> float:
        return self.line.em_gain

    def _close(self) -> None:
        self._runs = False


class RecordedLight(LightSource):
    """The light as it was when the frame was taken that the camera read last."""

    def __init__(self, camera: RecordedCamera) -> None:
        super().__init__()  # and no more: there is nothing to make safe
        self._camera = camera

    @property
    def name(self) -> str:
        """What it is."""
        return "as recorded"

    def _read_range(self) -> Range:
        return Range(self._read_current(), self._read_current())

    def _read_current(self) -> float:
        return self._camera.line.light_current_a or 0.0

    def _set_current(self, current_a: float) -> float:
        return current_a  # no other is allowed

    def _is_lit(self) -> bool:
        return self._camera.line.is_light_on is not False

    def _switch(self, *, on: bool) -> None:
        if on != self._is_lit():
            raise Unsupported("this is a recording: its light stays as it was")

    def _close(self) -> None:
        """There is nothing to let go of."""


class RecordedStage(Stage):
    """The stage as it stood: the sample is in."""

    def __init__(self, recording: Recording) -> None:
        super().__init__()
        self._mask = recording.bench.simulation.source.mask

    @property
    def name(self) -> str:
        """What it is."""
        return "as recorded"

    def _read_masks(self) -> tuple[str, ...]:
        return (self._mask,)

    def _read_mask(self) -> str:
        return self._mask

    def _set_mask(self, mask: str) -> None:
        """There is no other."""

    def _is_sample_in(self) -> bool:
        return True

    def _set_sample_in(self, *, sample_in: bool) -> None:
        if not sample_in:
            raise Unsupported("this is a recording: its sample stays in the beam")

    def _close(self) -> None:
        """There is nothing to let go of."""
