"""Replay of a recording in the live view, each frame with its own calibration."""

from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path

from app.acquisition.instrument import Instrument
from app.acquisition.remote.connection import RunningInstrument
from app.acquisition.worker import Acquisition
from app.bench.config import Bench, load_bench
from app.errors import InputError
from app.measurement.calibration import Calibration
from app.measurement.measurement import Measurement
from app.recording.playback_devices import RecordedCamera, playback_devices
from app.recording.reader import Recording
from app.results.replay import change_of
from drivers.interface import Devices, Frame, FrameLost, WrongState


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

    def take(self, _: Measurement) -> None:
        """Between two frames, set the calibration of the next if it is another.

        The camera holds that frame back until then, because a slow computer might read it before.
        """
        if self._camera is None or self._acquisition is None:
            return
        self.position = self.frames.index(self._camera.line.index)
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
