"""A recording in place of the devices, with its dark and reference."""

import math
from contextlib import ExitStack
from dataclasses import replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from app.bench.device_kinds import Pace
from app.errors import InputError
from app.measurement.averages import Average
from app.measurement.calibration import Calibration
from app.recording.frame_lines import FrameLine
from app.recording.reader import Recording
from drivers.interface import (
    Camera,
    CameraCapabilities,
    Devices,
    DeviceTimeout,
    Disconnected,
    Frame,
    FrameLost,
    LightSource,
    Range,
    Stage,
)
from reconstruction.arrays import Floats
from simulated_devices.clock import Clock

_LONGEST_GAP_S = 1.0  # beyond an exposure; longer gaps, for example for a new reference, are shortened
_LATE_S = 1.0  # the recording waits for a reader that is later
_FULL_SCALE = 65535  # without a calibration
_ROUNDING = 1 / 6  # variance of the difference of two rounded numbers, counts^2


def playback_devices(recording: Recording, frames: range, *, pace: Pace, repeat: bool) -> Devices:
    """Open the devices that play some frames of a recording while the light is on and the sample in."""
    with ExitStack() as stack:
        camera = stack.enter_context(RecordedCamera(recording, frames, pace=pace, repeat=repeat))
        stage = stack.enter_context(RecordedStage(camera, recording.bench.simulation.source.mask))
        light = stack.enter_context(RecordedLight(camera))
        return Devices(camera, light, stage, stack.pop_all())


class RecordedCamera(Camera):
    """Plays frames at the times of their arrival; lost frames are lost again.

    After a stop it continues at the same frame. With the light on and the sample in it returns the recorded frames,
    else frames whose average is the dark or the reference of the next frame. At the fastest pace a frame comes as soon
    as it is read, and its camera time is when it would have come. A frame whose line or pixels are damaged counts as
    lost; a folder that has become unreadable, as on a lost network share, as an unplugged camera.
    """

    def __init__(
        self, recording: Recording, frames: range, *, pace: Pace, repeat: bool, clock: Clock | None = None
    ) -> None:
        super().__init__()
        self._recording, self._frames, self._clock = recording, frames, clock or Clock()
        self._pace, self._repeat = pace, repeat
        self._position = 0  # of the next frame in `frames`
        self._is_playing = False
        self._count = 0  # index of the next frame since the start, lost ones included
        self._due_s = 0.0  # time of the next frame
        self._averaged = lru_cache(maxsize=2)(AveragedFrames)
        self._shape = recording.frame_shape
        self._pixel_pitch_m = recording.bench.sensor.pixel_pitch_m
        self.line = recording.line(frames[0])  # of the recorded frame that was read last, or of the first
        self.is_lit = self.is_sample_in = False
        self.damaged: dict[int, str] = {}  # reason by position in the played range, of the frames that were met
        self.in_force: int | None = None  # number of the calibration in use; frames of another wait for theirs
        self.speed = 1.0  # times the recorded rate

    @property
    def name(self) -> str:
        """Name of the recording."""
        return f"recording {self._recording.folder.name}"

    @property
    def next_frame(self) -> int:
        """Index of the next frame in the recording; at the end, of the last."""
        return self._frames[min(self._position, len(self._frames) - 1)]

    @property
    def next_calibration(self) -> int | None:
        """Number of the calibration of the next frame."""
        return self._line().calibration

    def show(self, position: int) -> Frame:
        """Return the frame at a position at once, also while stopped, or `FrameLost`; playing continues after it."""
        self._position, self._due_s = position, self._clock.now()
        return self._play()

    def see(self, *, is_lit: bool, is_sample_in: bool) -> None:
        """Set the light and the sample."""
        self.is_lit, self.is_sample_in = is_lit, is_sample_in
        self._cached_capabilities = None  # exposure and gain may differ

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
            readout_speeds=(_readout_speed(self._recording),),
        )

    def _is_running(self) -> bool:
        return self._is_playing

    def _start(self) -> None:
        self._is_playing, self._count = True, 0
        self._due_s = self._clock.now() + self._taken().exposure_s

    def _stop(self) -> None:
        self._is_playing = False

    _close = _stop

    def _read(self, timeout_s: float) -> Frame:
        wait_s = self._due_s - self._clock.now()
        if self._pace == "fastest":
            wait_s = 0.0 if timeout_s > 0 else math.inf
        absence = "the recording has no frame at this time" if wait_s > timeout_s else self._absence()
        if absence:
            self._clock.sleep(timeout_s)
            raise DeviceTimeout(absence)
        average = self._average()
        self._clock.sleep(max(wait_s, 0.0))
        return self._play() if average is None else self._show(average)

    def _play(self) -> Frame:
        """Return the next recorded frame and schedule the one after it."""
        damage = None
        try:
            frame = self._recording.frame(self.next_frame)
        except InputError as error:  # if the folder is gone, the next line raises
            damage = error
        before = self._line()
        self._position += 1
        if self._repeat:
            self._position %= len(self._frames)
        after = self._line()
        self.line, self._cached_capabilities = before, None  # exposure and gain may differ
        follows = after.index > before.index
        gap_s = after.host_time_s - before.host_time_s if follows else after.exposure_s
        gap_s = min(max(gap_s, 0.0), after.exposure_s + _LONGEST_GAP_S)
        index, due_s = self._advance(gap_s, lost=after.lost if follows else 0)
        if damage is not None:
            self.damaged[self._frames.index(before.index)] = str(damage)
            raise FrameLost(str(damage)) from damage
        return replace(frame, index=index, camera_time_s=due_s, host_time_s=self._clock.now())

    def _show(self, average: Average) -> Frame:
        pixels = self._averaged(average, self.capabilities.full_scale).pixels(self._count)
        index, due_s = self._advance(average.exposure_s, lost=0)
        return Frame(
            pixels=pixels,
            index=index,
            camera_time_s=due_s,
            host_time_s=self._clock.now(),
            exposure_s=average.exposure_s,
            em_gain=average.em_gain,
        )

    def _advance(self, gap_s: float, *, lost: int) -> tuple[int, float]:
        """Schedule the next frame after a gap and some lost frames; return index and time of the present one."""
        present = self._count, self._due_s
        self._count += 1 + lost
        if self._pace == "own":
            self._due_s = max(self._due_s, self._clock.now() - _LATE_S)
        self._due_s += gap_s / self.speed
        return present

    def _absence(self) -> str:
        if self.is_lit and self.is_sample_in:
            if self._position == len(self._frames):
                return f"{self.name} has ended: all {len(self._frames)} frames were played"
            number = self._line().calibration
            waits = None not in {number, self.in_force} and number != self.in_force
            return "the next frame waits for its calibration" if waits else ""
        what = "reference" if self.is_lit else "dark"
        return "" if self._average() is not None else f"{self.name} holds no {what}"

    def _average(self) -> Average | None:
        """The dark or reference, if that is in view and exists."""
        calibration = self._calibration()
        if calibration is None or (self.is_lit and self.is_sample_in):
            return None
        return calibration.reference if self.is_lit else calibration.dark

    def _calibration(self) -> Calibration | None:
        number = self._line().calibration
        try:
            return None if number is None else self._recording.calibration(number)
        except InputError as error:
            raise Disconnected(str(error)) from error

    def _line(self) -> FrameLine:
        """The line of the next frame; if it is damaged, the last one in its place."""
        try:
            return self._recording.line(self.next_frame)
        except InputError as error:
            if isinstance(error.__cause__, OSError):
                raise Disconnected(str(error)) from error
            return replace(self.line, index=self.next_frame, lost=0)

    def _taken(self) -> Average | FrameLine:
        """Average or frame line that supplies exposure and gain."""
        return self._average() or self.line

    def _read_exposure(self) -> float:
        return self._taken().exposure_s

    def _set_exposure(self, exposure_s: float) -> float:  # noqa: ARG002 - no other is allowed
        return self._read_exposure()

    def _read_em_gain(self) -> float:
        return self._taken().em_gain


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

    def _set_sample_in(self, *, is_in: bool) -> None:
        self._camera.see(is_lit=self._camera.is_lit, is_sample_in=is_in)


class AveragedFrames:
    """Frames that alternate about an average by their spread: the mean is exact, the variance nearly."""

    def __init__(self, average: Average, full_scale: int) -> None:
        self._frames, self._spread = average.frames, _spread(average, full_scale)
        self._sum = np.rint(average.mean.astype(np.float64) * average.frames)
        rng, shape = np.random.default_rng(0), average.mean.shape  # so that pixels do not alternate together
        self._first = rng.integers(self._frames, size=shape)
        self._remainder = rng.random(shape, np.float32)  # count; decorrelates rounding from the alternation

    def pixels(self, index: int) -> NDArray[np.uint16]:
        """Frame number `index` (row, column), counts, read-only."""
        step = (self._first + index) % self._frames
        pixels = (self._total(step + 1) - self._total(step)).astype(np.uint16)
        pixels.flags.writeable = False
        return pixels

    def _total(self, frames: NDArray[np.int64]) -> Floats:
        """Sum of each pixel's first frames, (row, column), in whole counts, so that rounding errors do not add up."""
        is_up = (frames % 2 == 1) & (frames < self._frames)
        total: Floats = np.floor(frames * self._sum / self._frames + is_up * self._spread + self._remainder)
        return total


def _spread(average: Average, full_scale: int) -> Floats:
    """Amplitude of each pixel's alternation that gives its variance, (row, column), counts."""
    pairs, mean = average.frames // 2, average.mean.astype(np.float64)
    scale = math.sqrt((average.frames - 1) / (2 * pairs)) if pairs else 0.0
    wanted = scale * np.sqrt(np.maximum(average.variance.astype(np.float64) - _ROUNDING, 0))
    room = np.floor(np.minimum(mean, full_scale - mean))
    spread: Floats = np.clip(wanted, 0, np.maximum(room, 0))
    return spread


def _readout_speed(recording: Recording) -> int:
    """Return the readout speed at the start of a recording; 1 if `run.json` does not tell."""
    devices = recording.run.get("devices")
    camera = devices.get("camera") if isinstance(devices, dict) else None
    speed = camera.get("readout_speed") if isinstance(camera, dict) else None
    return speed if type(speed) is int else 1
