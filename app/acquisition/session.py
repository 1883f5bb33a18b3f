"""A live bench for scripts and notebooks: an acquisition that is started, iterated over, and closed."""

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Self, TypeVar

from app.acquisition.devices import open_devices
from app.acquisition.instrument import Instrument
from app.acquisition.start_up import FRAMES, knows_sample, start_up
from app.acquisition.streams.publisher import stream_sinks
from app.acquisition.worker import Acquisition
from app.bench.config import Bench
from app.errors import RunError
from app.measurement.estimator import whole_number
from app.measurement.measurement import SKIPPED, Measurement
from app.recording.recorder import Limit
from drivers.interface import Devices, WrongState

T = TypeVar("T")

_WAIT_S = 0.1  # between two checks whether the acquisition still runs


class LiveBench:
    """The devices of one bench, opened and closed by a `with` block; iterate over it for measurements.

    Entering opens the devices, turns the light on, takes a dark and a reference, moves the sample in and starts the
    camera. On a bench without motors, take the reference yourself. Leaving stops the
    camera, turns the light off and closes the devices, also after an error or Ctrl-C.

    Parameters
    ----------
    bench
        The bench.
    average
        Number of frames averaged in the first dark and the first reference.
    """

    def __init__(self, bench: Bench, *, average: int = FRAMES) -> None:
        self._bench, self._average = bench, average
        self._arrived = threading.Condition()
        self._newest: Measurement | None = None
        self._entered: Acquisition | None = None
        self._streams = ExitStack()

    def __enter__(self) -> Self:
        if self._entered is not None:
            raise WrongState("this live bench was entered before: call svwfs.live again")
        sinks = self._streams.enter_context(stream_sinks(self._bench))
        self._entered = acquisition = Acquisition(self._bench, open_devices, (self._take, *sinks))
        acquisition.start()
        try:
            for step in start_up(acquisition, self._average):
                self._result(step)
        except BaseException:
            self._close()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._close()
        if error is None:
            self._raise_failure()
        elif self._acquisition.failure and self._acquisition.error is not error:
            error.add_note(self._acquisition.failure)  # the light may still be on

    def __iter__(self) -> Iterator[Measurement]:
        """Yield the newest measurement whenever there is one; frames that come in between are skipped.

        `measurement.counts` counts them; `record` keeps every frame. It ends with the block, and raises the error that
        ended the acquisition. After the block there is nothing to iterate over: `WrongState`.
        """
        acquisition = self._acquisition
        if not acquisition.is_alive:
            self._raise_failure()
            raise WrongState("this live bench is closed: its with block has ended")
        return self._measurements(acquisition)

    def _measurements(self, acquisition: Acquisition) -> Iterator[Measurement]:
        while True:
            with self._arrived:
                while self._newest is None and acquisition.is_alive:
                    self._arrived.wait(_WAIT_S)
                measurement, self._newest = self._newest, None
            if measurement is None:
                self._raise_failure()
                return
            yield measurement

    @property
    def bench(self) -> Bench:
        """The bench with the lattice, exposure, gain and current now in force."""
        status = self._acquisition.status
        return self._bench if status is None else status.bench_in_force

    @property
    def warning(self) -> str:
        """Why wavefronts are missing or doubtful, such as a stale reference; empty when they are good."""
        status = self._acquisition.status
        return "" if status is None else status.warning

    def take_dark(self, frames: int = FRAMES) -> None:
        """Average `frames` frames with the light off and use the mean as dark from now on."""
        self._result(self._acquisition.take_dark(frames))

    def take_reference(self, frames: int = FRAMES) -> None:
        """Average `frames` frames without the sample and use the mean as reference from now on."""
        self._result(self._acquisition.take_reference(frames))

    def note_sample_in(self) -> None:
        """Note in recordings that the sample is in the beam; only needed on a bench without motors."""
        self._set(lambda devices: devices.stage.note_sample(True))

    def set_exposure(self, exposure_s: float) -> float:
        """Change the exposure time, s; return the one in force. Dark and reference are stale until taken again."""
        wanted_s = float(exposure_s)
        return self._set(lambda devices: devices.camera.set_exposure(wanted_s))

    def set_em_gain(self, em_gain: float) -> float:
        """Change the electron multiplication; return the one in force. Dark and reference are stale until retaken."""
        wanted = float(em_gain)
        return self._set(lambda devices: devices.camera.set_em_gain(wanted))

    def set_light_current(self, current_a: float) -> float:
        """Change the current of the light, A; return the one in force. The reference is stale until taken again."""
        wanted_a = float(current_a)
        return self._set(lambda devices: devices.light.set_current(wanted_a))

    def set_light(self, on: bool) -> None:
        """Switch the light, or note that you switched it by hand. Off works at once, and ends a routine."""
        if not on and not self._bench.has_manual_light:
            self._result(self._acquisition.switch_light_off())
        self._set(lambda devices: devices.light.note_light(bool(on)))

    def auto_expose(self) -> float:
        """Set exposure and light current so that the brightest lenslets fill 70 % of full scale; return the exposure.

        The dark and the reference are stale afterwards: take them again.
        """
        return self._result(self._acquisition.auto_expose()).exposure_s

    def record(self, folder: Path | str, frames: int) -> Path:
        """Record the next `frames` frames into a new folder, wait for the last one, and return the folder.

        It begins when layers of the sample have been searched for, if they may be assumed.

        Raises
        ------
        InputError
            If the folder holds a recording already, or `frames` is less than 1.
        RunError
            If the recording ended early; the frames so far are kept.
        """
        folder, acquisition = Path(folder), self._acquisition
        while acquisition.is_alive and not knows_sample(acquisition):
            with self._arrived:
                self._arrived.wait(_WAIT_S)
        self._result(
            acquisition.start_recording(folder, command="python", limit=Limit(frames=whole_number(frames, "frames")))
        )
        try:
            while (state := acquisition.recording) is not None and state.stage in {"recording", "finishing"}:
                with self._arrived:
                    self._arrived.wait(_WAIT_S)
                if not acquisition.is_alive:
                    self._raise_failure()
        except BaseException:  # Ctrl-C, too: the frames so far are a recording
            acquisition.stop_recording()
            raise
        if state is not None and state.problem:
            self._raise_failure()
            raise RunError(state.problem)
        return folder

    @property
    def _acquisition(self) -> Acquisition:
        if self._entered is None:
            raise WrongState("a live bench works in a with block: with svwfs.live(bench) as live: ...")
        return self._entered

    def _close(self) -> None:
        with self._streams:
            self._acquisition.close()
        self._newest = None

    def _take(self, measurement: Measurement) -> None:
        if measurement.problem == SKIPPED:  # a newer frame follows
            return
        with self._arrived:
            self._newest = measurement
            self._arrived.notify_all()

    def _set(self, change: Callable[[Devices], T]) -> T:
        """Change the devices, the camera paused: all later measurements are of frames exposed after the change."""

        def command(instrument: Instrument) -> T:
            with instrument.devices.camera.paused():
                return change(instrument.devices)

        return self._result(self._acquisition.submit(command))

    def _result(self, step: Future[T]) -> T:
        """Wait for a command and return its result; an error that ended the acquisition goes before the command's."""
        try:
            found = step.result()
        except Exception:
            self._raise_failure()
            raise
        with self._arrived:
            self._newest = None  # measured before the command
        return found

    def _raise_failure(self) -> None:
        if self._acquisition.error is not None:
            raise self._acquisition.error
