"""A camera that plays a recording: its frames, or where the light is off or the sample out, its dark or reference."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache

from app.bench.recording_settings import Pace
from app.errors import InputError
from app.measurement.calibration import Calibration
from app.measurement.routines.averages import Average
from app.recording.averaged import AveragedFrames
from app.recording.frame_line import FrameLine
from app.recording.reader import Recording
from drivers.interface import Camera, CameraCapabilities, DeviceTimeout, Disconnected, Frame, FrameLost, Range

_LONGEST_GAP_S = 1.0  # beyond an exposure, in which nothing was recorded: as while a new reference was taken
_LATE_S = 1.0  # when nobody has read for so long, the recording waits
_FULL_SCALE = 65535  # where no calibration tells it


class RecordedCamera(Camera):
    """Plays frames by the times at which they arrived; those that were lost are lost again.

    When it is stopped and started it goes on where it was. It sees what the light and the stage let it see: the frames
    with the light on and the sample in, else frames whose average is the dark, or the reference, that belongs to the
    next frame. At the fastest pace a frame comes as soon as it is waited for, and its time on the camera's clock is
    when it would have come. A frame whose pixels are missing or damaged is lost; a folder that cannot be read any more,
    as on a disk or a share that is gone, is a camera that was unplugged.
    """

    def __init__(
        self,
        recording: Recording,
        frames: range,
        *,
        pace: Pace = "own",
        repeat: bool = True,
        now: Callable[[], float] = time.perf_counter,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        super().__init__()
        self._recording, self._frames, self._now, self._sleep = recording, frames, now, sleep
        self._pace, self._repeat = pace, repeat
        self._position = 0  # among `frames`, of the next one
        self._runs = False
        self._count = 0  # since the start, lost ones included: the index of the next frame
        self._due_s = 0.0  # when the next one comes
        self._averaged = lru_cache(maxsize=2)(AveragedFrames)
        self._shape = recording.frame_shape
        self._pixel_pitch_m = recording.bench.sensor.pixel_pitch_m
        self.line = recording.line(frames[0])  # of the recorded frame that was read last, at first of the first
        self.is_lit = self.is_sample_in = False
        self.in_force: int | None = None  # the calibration that frames are measured by: those of another wait for it

    @property
    def name(self) -> str:
        """Which recording it is."""
        return f"recording {self._recording.folder.name}"

    @property
    def next_frame(self) -> int:
        """The index in the recording of the frame that comes next; at its end, of the last."""
        return self._frames[min(self._position, len(self._frames) - 1)]

    def see(self, *, is_lit: bool, is_sample_in: bool) -> None:
        """See something else from now on."""
        self.is_lit, self.is_sample_in = is_lit, is_sample_in
        self._cached_capabilities = None  # it may have been taken otherwise

    def _read_capabilities(self) -> CameraCapabilities:
        rows, columns = self._shape
        taken, calibration = self._taken(), self._calibration()
        return CameraCapabilities(
            rows=rows,
            columns=columns,
            pixel_pitch_m=self._pixel_pitch_m,
            full_scale=_FULL_SCALE if calibration is None else int(calibration.full_scale),
            exposure_range_s=Range(taken.exposure_s, taken.exposure_s),
            em_gain_range=Range(taken.em_gain, taken.em_gain),
            amplifiers=("as recorded" if calibration is None else calibration.reference.amplifier,),
        )

    def _is_running(self) -> bool:
        return self._runs

    def _start(self) -> None:
        self._runs, self._count = True, 0
        self._due_s = self._now() + self._taken().exposure_s

    def _stop(self) -> None:
        self._runs = False

    def _read(self, timeout_s: float) -> Frame:
        average, absence = self._average(), self._absence()
        wait_s = self._due_s - self._now()
        if self._pace == "fastest":
            wait_s = 0.0 if timeout_s > 0 else math.inf
        if absence or wait_s > timeout_s:
            self._sleep(timeout_s)
            raise DeviceTimeout(absence or "the recording has no frame at this moment")
        self._sleep(max(wait_s, 0.0))
        return self._play() if average is None else self._show(average)

    def _play(self) -> Frame:
        """Return the next of the recorded frames, and find out which one follows, and when."""
        damage = None
        try:
            frame = self._recording.frame(self.next_frame)
        except InputError as error:  # or the folder is gone, as its line tells now
            damage = error
        before = self._line()
        self._position += 1
        if self._repeat:
            self._position %= len(self._frames)
        after = self._line()
        self.line, self._cached_capabilities = before, None  # other frames may have been taken otherwise
        follows = after.index > before.index
        gap_s = after.host_time_s - before.host_time_s if follows else after.exposure_s
        index, due_s = self._pass(
            gap_s=min(max(gap_s, 0.0), after.exposure_s + _LONGEST_GAP_S), lost=after.lost if follows else 0
        )
        if damage is not None:
            raise FrameLost(str(damage)) from damage
        return replace(frame, index=index, camera_time_s=due_s, host_time_s=self._now())

    def _show(self, average: Average) -> Frame:
        """Return the next of the frames that have an average."""
        pixels = self._averaged(average, self.capabilities.full_scale).pixels(self._count)
        index, due_s = self._pass(gap_s=average.exposure_s, lost=0)
        return Frame(pixels, index, due_s, self._now(), average.exposure_s, average.em_gain)

    def _pass(self, *, gap_s: float, lost: int) -> tuple[int, float]:
        """Go on behind a frame, to that after a gap and so many lost ones; return its index and when it was due."""
        passed = self._count, self._due_s
        self._count += 1 + lost
        if self._pace == "own":
            self._due_s = max(self._due_s, self._now() - _LATE_S)
        self._due_s += gap_s
        return passed

    def _absence(self) -> str:
        """Why no frame comes any more; empty when one does."""
        if self.is_lit and self.is_sample_in:
            if self._position == len(self._frames):
                return f"{self.name} has ended: its {len(self._frames)} frames have been shown"
            number = self._line().calibration
            waits = None not in {number, self.in_force} and number != self.in_force
            return "the next frame waits for its calibration" if waits else ""
        what = "reference" if self.is_lit else "dark"
        return "" if self._average() is not None else f"{self.name} holds no {what}"

    def _average(self) -> Average | None:
        """The dark or the reference, if it is that which is seen, and there is one."""
        calibration = self._calibration()
        if calibration is None or (self.is_lit and self.is_sample_in):
            return None
        return calibration.reference if self.is_lit else calibration.dark

    def _calibration(self) -> Calibration | None:
        """The one that belongs to the next frame."""
        number = self._line().calibration
        try:
            return None if number is None else self._recording.calibration(number)
        except InputError as error:
            raise Disconnected(str(error)) from error

    def _line(self) -> FrameLine:
        """What there is to say of the next frame; whether the recording is there at all."""
        try:
            return self._recording.line(self.next_frame)
        except InputError as error:
            raise Disconnected(str(error)) from error

    def _taken(self) -> Average | FrameLine:
        """What says how that was taken which is seen."""
        return self._average() or self.line

    def _read_exposure(self) -> float:
        return self._taken().exposure_s

    def _set_exposure(self, exposure_s: float) -> float:  # noqa: ARG002 - no other is allowed
        return self._read_exposure()

    def _read_em_gain(self) -> float:
        return self._taken().em_gain

    def _close(self) -> None:
        self._runs = False
