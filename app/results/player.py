"""Replay of a recording in the live view, each frame with its own calibration."""

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np

from app.acquisition.instrument import Instrument
from app.acquisition.remote.connection import RunningInstrument
from app.acquisition.start_up import start_up
from app.acquisition.worker import Acquisition
from app.bench.config import Bench, load_bench
from app.errors import InputError
from app.measurement.calibration import Calibration
from app.measurement.measurement import SKIPPED, Measurement
from app.recording.playback_devices import RecordedCamera, playback_devices
from app.recording.reader import Recording
from app.results.replay import change_of
from drivers.interface import Devices, Frame, FrameLost, WrongState
from reconstruction.arrays import Floats

Fault: TypeAlias = Literal["dark", "saturated", "bad"]


@dataclass(frozen=True, slots=True, eq=False)
class Overview:
    """Course of a recording as it was live, by position in the played frames."""

    time_s: Floats  # since the first frame, (frame,)
    rms_rad: Floats  # mean over the views, (frame,); NaN without a wavefront
    valid: Floats  # number of lenslets, (frame,); NaN without a wavefront
    is_dark: frozenset[int]  # frames that were taken with the light off
    faults: dict[int, tuple[Fault, str]]  # kind and reason of each frame that has one

    def course(self, points: int) -> tuple[Floats, Floats, Floats]:
        """Return the times of at most so many points, and number of lenslets and RMS there, each of its largest.

        A point has the fewest lenslets and the largest RMS of the frames that it stands for, NaN without a wavefront.
        """
        first = np.arange(0, len(self.time_s), -(-len(self.time_s) // points))
        time_s, valid = self.time_s[first], np.fmin.reduceat(self.valid, first)
        rms_rad, longest_s = np.fmax.reduceat(self.rms_rad, first), max(float(self.time_s[-1]), 1e-9)
        most = (max(float(np.nanmax(values, initial=0)), 1e-9) for values in (self.valid, self.rms_rad))
        return time_s / longest_s, valid / next(most), rms_rad / next(most)

    def at(self, position: int) -> str:
        """Return time, RMS and number of valid lenslets of a frame in words."""
        time_s, rms_rad, valid = (values[position] for values in (self.time_s, self.rms_rad, self.valid))
        measured = f"RMS {rms_rad:.3g} rad, {valid:.0f} valid lenslets" if np.isfinite(rms_rad) else "no wavefront"
        return f"{time_s:.2f} s: {measured}"

    def in_words(self, frames: range) -> list[tuple[int, str]]:
        """Return position, and place and reason in words, of each of the `frames` that has a fault."""
        return [
            (position, f"frame {frames[position]}, {self.time_s[position]:.2f} s, {kind}: {reason}")
            for position, (kind, reason) in sorted(self.faults.items())
        ]


class Player:
    """Opens devices that play a recording, and sets the calibration of each frame.

    `position` is that of the newest frame in `frames`, the played indices; None before the first. Any thread may call
    `show_frame` and `set_speed`.
    """

    def __init__(
        self, folder: Path, *, bench: str | None = None, settings: tuple[str, ...] = (), frames: str | None = None
    ) -> None:
        """Use another `bench`, or changed `settings` of the recorded one, if given."""
        self._recording = Recording(folder)
        self.folder, self.frames = folder, self._recording.select(frames)
        self.position: int | None = None
        self._recent: deque[tuple[float, int]] = deque(maxlen=100)  # camera time and position
        self._speed = 1.0
        self._change = change_of(None if bench is None else load_bench(bench, settings), settings)
        self._camera: RecordedCamera | None = None
        self._acquisition: Acquisition | None = None
        first = self._recording.first_calibration(self.frames)
        if first is None:
            raise InputError(f"{folder}: these frames have no calibration: there is nothing to reconstruct them with")
        self._first = self._asked = first
        self.bench = self._calibration(first).bench

    def open_devices(self, _bench: Bench, _progress: Callable[[float], None]) -> Devices:
        """Open the devices, at the first frame."""
        self.position = None
        devices = playback_devices(self._recording, self.frames, pace="own", repeat=True)
        self._camera = devices.camera if isinstance(devices.camera, RecordedCamera) else None
        self.set_speed(self._speed)
        return devices

    def acquisition(self) -> Acquisition:
        """Make an acquisition that plays the recording."""
        return Acquisition(self.bench, self.open_devices, sinks=(self.take,))

    def begin(self, acquisition: RunningInstrument) -> tuple[Future[None], ...]:
        """Set the recorded calibration and start the camera, instead of taking dark and reference."""
        if not isinstance(acquisition, Acquisition):
            raise TypeError("a recording is played in this process")
        self._acquisition, self._asked = acquisition, self._first
        used = self._use(acquisition, self._first)
        return (used, acquisition.set_light_on(True), acquisition.set_sample_in(True), acquisition.set_running(True))

    def take(self, measurement: Measurement) -> None:
        """Between two frames, set the next frame's calibration, for which the camera waits, if it is another."""
        if self._camera is None or self._acquisition is None:
            return
        self.position = self.frames.index(self._camera.line.index)
        self._recent.append((measurement.frame.camera_time_s, self.position))
        number = self._camera.next_calibration
        if number is not None and number != self._asked:
            self._asked = number
            self._use(self._acquisition, number)

    def show_frame(self, position: int) -> Future[None]:
        """Stop, and show the frame at a position in `frames`; a damaged one is an `InputError` of the future."""

        def choose(instrument: Instrument) -> Frame:
            if self._camera is None:
                raise WrongState("the recording is not open")
            try:
                number = self._recording.line(self.frames[position]).calibration
            except InputError as error:
                self._camera.damaged[position] = str(error)
                raise
            if number is not None and number != self._camera.in_force:
                self._asked = number
                self._set(instrument, number)
            try:
                return self._camera.show(position)
            except FrameLost as error:
                raise InputError(str(error)) from error

        if self._acquisition is None:
            refused: Future[None] = Future()
            refused.set_exception(WrongState("the recording is not open"))
            return refused
        return self._acquisition.show_single(choose)

    @property
    def damaged(self) -> dict[int, str]:
        """Reason of each damaged frame that was met, by its position in `frames`."""
        return {} if self._camera is None else dict(self._camera.damaged)

    def position_of(self, frame: Frame) -> int | None:
        """Return the position of a frame that was played lately, also while the worker plays others."""
        return next((at for time_s, at in reversed(self._recent.copy()) if time_s == frame.camera_time_s), None)

    def overview(self) -> Overview:
        """Read the lines of all played frames, which takes a second for ten thousand."""
        count = len(self.frames)
        time_s, rms_rad, valid = np.zeros(count), np.full(count, np.nan), np.full(count, np.nan)
        is_dark, faults = set[int](), dict[int, tuple[Fault, str]]()
        for position, index in enumerate(self.frames):
            try:
                line = self._recording.line(index)
            except InputError as error:
                time_s[position], faults[position] = time_s[max(position - 1, 0)], ("bad", str(error))
                continue
            time_s[position] = line.host_time_s
            if line.rms_rad is not None and line.valid is not None:
                rms_rad[position], valid[position] = line.rms_rad, line.valid
            if line.is_light_on is False:
                is_dark.add(position)
                faults[position] = "dark", "the light was off"
            elif line.problem and line.problem != SKIPPED:
                faults[position] = "saturated" if "saturated" in line.problem else "bad", line.problem
        known_s = time_s[time_s > 0]
        return Overview(np.maximum(time_s - known_s[:1].sum(), 0), rms_rad, valid, frozenset(is_dark), faults)

    def set_speed(self, speed: float) -> None:
        """Play at a multiple of the recorded rate."""
        self._speed = speed
        if self._camera is not None:
            self._camera.speed = speed

    def _calibration(self, number: int) -> Calibration:
        recorded = self._recording.calibration(number)
        return recorded if self._change is None else self._change(recorded)

    def _use(self, acquisition: Acquisition, number: int) -> Future[None]:
        return acquisition.commands.submit(self._set, number)

    def _set(self, instrument: Instrument, number: int) -> None:
        if self._camera is not None:
            self._camera.in_force = number
        instrument.use(self._calibration(number))


@dataclass(frozen=True, slots=True)
class InstrumentFactory:
    """Makes and begins the acquisition of a window, of devices or a recording, and another after each reconnection."""

    make: Callable[[], RunningInstrument]
    begin: Callable[[RunningInstrument], tuple[Future[Any], ...]] = start_up  # sends the first commands
    player: Player | None = None  # of a recording
