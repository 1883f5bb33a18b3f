"""A live bench for commands, scripts and notebooks: open, calibrate, iterate, record, close."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, wait
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Self, TypeVar

from app.acquisition.address import NAME
from app.acquisition.instrument import Status
from app.acquisition.remote.connection import RunningInstrument, reach
from app.acquisition.start_up import DARK, EXPOSURE, REFERENCE, is_recorded, knows_sample, start_up, without_sample
from app.acquisition.worker import Acquisition
from app.bench.config import Bench, as_bench
from app.errors import RunError
from app.measurement.averages import EXPOSURE_FRAMES, FRAMES
from app.measurement.measurement import Measurement
from app.measurement.offline_reconstructor import whole_number
from app.progress import Progress, counted
from app.recording.recorder import RecordingLimit, RecordingState
from drivers.interface import WrongState
from reconstruction.frame.linearity_fit import MeasuredLinearity

T = TypeVar("T")

_WAIT_S = 0.05  # between two checks whether the acquisition still runs, and how far it is
_FINISH_S = 10.0  # for a recording that was stopped
_SHUT_DOWN_S = 5.0  # for the instrument to say that it will


def live(bench: Bench, *, average: int = FRAMES) -> LiveBench:
    """Open the devices of a bench for a `with` block; iterate over it for measurements.

    Entering turns the light on, takes a dark and a reference, moves the sample in and starts the camera. Leaving stops
    the camera, turns the light off and closes the devices, also after an error. On a bench without motors, take the
    sample out, call `take_reference()`, put it in again, and call `note_sample_in()`.

    Parameters
    ----------
    bench
        The bench, simulated or real.
    average
        Number of frames averaged in the first dark and the first reference.

    Returns
    -------
    LiveBench
        Iterating yields the newest `Measurement`: `.wavefront`, or None with the reason in `.problem`; `.frame`;
        `.counts` of all frames. Its methods set the devices, calibrate and record.

    Raises
    ------
    DeviceError
        If a device is missing or fails.
    InputError
        If the bench cannot be used.

    Examples
    --------
    >>> with svwfs.live(bench) as instrument:
    ...     for measurement in instrument:
    ...         break
    >>> measurement.wavefront.views.shape
    (3, 3, 7, 7)
    """
    return LiveBench(as_bench(bench), average=average)


def connect(name: str = NAME, *, watch: bool = False) -> ConnectedBench:
    """Connect to an instrument of `svwfs serve` or `svwfs live` in another process, for a `with` block.

    Any number of programs may be connected. One has control, the first to come unless it watches; commands of the
    others are refused, except that anyone may switch the light off. Leaving the block leaves the instrument running.

    Parameters
    ----------
    name
        Name of the instrument, as given to `svwfs serve --name`.
    watch
        Do not take control, even if nobody has it.

    Returns
    -------
    ConnectedBench
        A `LiveBench` with `take_control`, `shut_down`, and `every()`, which iterates over every measurement.

    Raises
    ------
    RunError
        If no instrument of that name runs or answers.

    Examples
    --------
    In a terminal: svwfs serve --bench small_demo

    >>> with svwfs.connect() as instrument:  # doctest: +SKIP
    ...     for measurement in instrument:
    ...         break
    """
    return ConnectedBench("notebook", name, is_watching=watch)


class LiveBench:
    """The devices of one bench, opened and closed by a `with` block; iterate over it for measurements."""

    def __init__(self, bench: Bench, *, average: int = FRAMES, progress: Progress = lambda *_: None) -> None:
        """Take no averages on entering if `average` is 0; `progress` receives what a method waits for."""
        self._bench, self._average, self._progress = bench, average, progress
        self._arrived = threading.Condition()
        self._newest: Measurement | None = None
        self._entered: RunningInstrument | None = None

    def _open(self) -> RunningInstrument:
        return Acquisition(self._bench, sinks=(self._take,))

    def __enter__(self) -> Self:
        if self._entered is not None:
            raise WrongState("this live bench was entered before: make another one")
        self._entered = acquisition = self._open()
        acquisition.start()
        try:
            for step in start_up(acquisition, self._average) if self._average else ():
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
        return self._until_failure(iter(self._next, None))

    def _until_failure(self, measurements: Iterator[Measurement]) -> Iterator[Measurement]:
        if not self._acquisition.is_alive:
            self._raise_failure()
            raise WrongState("this live bench is closed: its with block has ended")

        def passed_on() -> Iterator[Measurement]:
            yield from measurements
            self._raise_failure()

        return passed_on()

    def _next(self) -> Measurement | None:
        """Wait for a newer measurement; None if none follows."""
        with self._arrived:
            while self._newest is None and self._acquisition.is_alive:
                self._arrived.wait(_WAIT_S)
            measurement, self._newest = self._newest, None
            return measurement

    @property
    def bench(self) -> Bench:
        """The bench with the lattice, exposure, gain and current now in force."""
        status = None if self._entered is None else self._entered.status
        return self._bench if status is None else status.bench_in_force

    @property
    def warning(self) -> str:
        """Reason why wavefronts are missing or doubtful, such as a stale reference; empty when they are good."""
        status = self._acquisition.status
        return "" if status is None else status.warning

    @property
    def failure(self) -> str:
        """Reason why the devices were closed without a request; empty if they were not."""
        return self._acquisition.failure

    @property
    def recording(self) -> RecordingState | None:
        """State of the present or last recording; None before the first."""
        return self._acquisition.recording

    def calibrate(self, ask: Callable[[str], object], frames: int = FRAMES, *, auto_expose: bool = False) -> None:
        """Take a dark and a reference of `frames` frames each, then move the sample in.

        A person whom `ask` asks does what has no motor. With `auto_expose` the exposure is found first. If the
        reference is unusable, it is a `RunError`, but a person is asked to try again, before the sample is moved.
        """
        bench, acquisition = self._bench, self._acquisition
        if request := without_sample(bench):
            ask(request)
        steps = (EXPOSURE, DARK, REFERENCE) if auto_expose else (DARK, REFERENCE)
        if bench.has_manual_light:
            for step in steps:
                ask(f"switch the light {'on' if step.is_lit else 'off'}")
                self._changed(partial(acquisition.set_light_on, step.is_lit))
                self._result(step.begin(acquisition, frames))
        else:  # all are sent at once: a light that goes off meanwhile stays off
            lit = acquisition.set_light_on(True)
            for future in (lit, *(step.begin(acquisition, frames) for step in steps)):
                self._result(future)
        while not self._status().is_calibrated:
            sentence = f"the reference is unusable: {self.warning}"
            if not bench.has_manual_stage:
                raise RunError(sentence)
            ask(f"{sentence}; check light, mask and focus, the sample out of the beam")
            self.take_reference(frames)
        if bench.has_manual_stage:
            ask("put the sample into the beam")
        self.note_sample_in()

    def take_dark(self, frames: int = FRAMES) -> None:
        """Average `frames` frames with the light off and use the mean as dark from now on."""
        self._result(self._acquisition.take_dark(frames))

    def take_reference(self, frames: int = FRAMES) -> None:
        """Average `frames` frames without the sample and use the mean as reference from now on."""
        self._result(self._acquisition.take_reference(frames))

    def note_sample_in(self) -> None:
        """Note in recordings that the sample is in the beam; only needed on a bench without motors."""
        self._changed(partial(self._acquisition.set_sample_in, True))

    def set_exposure(self, exposure_s: float) -> float:
        """Change the exposure time, s; return the one in force. Dark and reference are stale until taken again."""
        return self._changed(partial(self._acquisition.set_exposure_s, float(exposure_s)))

    def set_em_gain(self, em_gain: float) -> float:
        """Change the electron multiplication; return the one in force. Dark and reference are stale until retaken."""
        return self._changed(partial(self._acquisition.set_em_gain, float(em_gain)))

    def set_light_current(self, current_a: float) -> float:
        """Change the current of the light, A; return the one in force. The reference may have another brightness."""
        return self._changed(partial(self._acquisition.set_current_a, float(current_a)))

    def set_light(self, on: bool) -> None:
        """Switch the light, or note that you switched it by hand. Off works at once, and ends a routine."""
        if not on and not self._bench.has_manual_light:
            self._result(self._acquisition.switch_light_off())
        self._changed(partial(self._acquisition.set_light_on, on))

    def auto_expose(self) -> float:
        """Set exposure and light current so that the brightest lenslets fill 70 % of full scale; return the exposure.

        The dark and the reference are stale afterwards: take them again.
        """
        return self._result(self._acquisition.auto_expose()).exposure_s

    def measure_linearity(self, frames: int = EXPOSURE_FRAMES) -> MeasuredLinearity:
        """Measure the camera's nonlinearity without the sample; nothing is changed.

        Exposures of `frames` frames each are taken with rising and falling length, twice; `.linearity` of the result is
        the section `[linearity]` of a bench. `RoutineError` says why it cannot be measured.
        """
        return self._result(self._acquisition.measure_linearity(frames))

    def record(self, folder: Path | str, frames: int, *, command: str = "python") -> Path:
        """Record the next `frames` frames into a new folder, wait for the last one, and return the folder.

        It begins when layers of the sample have been searched for, if they may be assumed; if the camera has not been
        started yet and there is nothing to search for, with its first frame. `command` is stored in `run.json`.

        Raises
        ------
        InputError
            If the folder holds a recording already, or `frames` is less than 1.
        RunError
            If the recording ended early; the frames so far are retained.
        """
        acquisition, status, folder = self._acquisition, self._status(), Path(folder).expanduser()
        limit = RecordingLimit(frames=whole_number(frames, "frames"))
        is_played = self._bench.is_recording  # each of its frames counts
        if is_first := not status.is_running and (is_played or not status.has_background_estimator):
            self._result(acquisition.start_recording(folder, command=command, limit=limit))
        self._start_camera()
        if not is_first:
            text = "finding layers and correction with the first frames"
            self._wait(lambda: knows_sample(acquisition) or not acquisition.is_alive, text)
            self._result(acquisition.start_recording(folder, command=command, limit=limit))

        def fraction() -> float:
            return 0.0 if acquisition.recording is None else acquisition.recording.frames / frames

        try:
            self._wait(lambda: is_recorded(acquisition), f"recording {counted(frames)}", fraction)
        except BaseException:  # Ctrl-C, too: the frames so far are a recording
            acquisition.stop_recording()
            ends_s = time.monotonic() + _FINISH_S
            while time.monotonic() < ends_s and acquisition.is_alive and not is_recorded(acquisition):
                time.sleep(_WAIT_S)
            raise
        if (state := acquisition.recording) is not None and state.problem:
            self._raise_failure()
            raise RunError(state.problem)
        return folder

    def _start_camera(self) -> None:
        self._result(self._acquisition.set_running(True))

    def _wait(self, is_over: Callable[[], bool], text: str, fraction: Callable[[], float] = lambda: 0.0) -> None:
        """Wait, a `fraction` of it done, until it is over; raise the error that ended the acquisition."""
        while not is_over():
            self._raise_failure()
            self._progress(text, fraction())
            with self._arrived:
                self._arrived.wait(_WAIT_S)

    def _status(self) -> Status:
        """Status, not older than the last command."""
        status = self._acquisition.status
        if status is None:
            self._raise_failure()
            raise WrongState("the devices are not open yet")
        return status

    @property
    def _acquisition(self) -> RunningInstrument:
        if self._entered is None:
            raise WrongState("a live bench works in a with block: with svwfs.live(bench) as live: ...")
        return self._entered

    def _close(self) -> None:
        self._acquisition.close()
        self._newest = None

    def _take(self, measurement: Measurement) -> None:
        if measurement.is_skipped:  # a newer frame follows
            return
        with self._arrived:
            self._newest = measurement
            self._arrived.notify_all()

    def _changed(self, change: Callable[[], Future[T]]) -> T:
        """Change a setting, the camera stopped meanwhile: all later measurements are of frames exposed afterwards."""
        status = self._acquisition.status
        if status is None or not status.is_running:
            return self._result(change())
        self._result(self._acquisition.set_running(False))
        try:
            return self._result(change())
        finally:
            self._start_camera()

    def _result(self, step: Future[T]) -> T:
        """Wait for a command's result; an error that ended the acquisition goes before the command's."""
        try:
            while not wait([step], _WAIT_S).done:
                activity = self._acquisition.activity
                self._progress(activity.text, activity.progress)
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


class ConnectedBench(LiveBench):
    """An instrument that runs in another process, entered and left by a `with` block; see `connect`."""

    def __init__(
        self, what: str, name: str = NAME, *, is_watching: bool = False, progress: Progress = lambda *_: None
    ) -> None:
        """Make a session whose name for other clients is `what`."""
        self._connection = connection = reach(what, name, sinks=(self._take,), takes_control=not is_watching)
        super().__init__(connection.bench, average=0, progress=progress)

    def _open(self) -> RunningInstrument:
        return self._connection

    def every(self) -> Iterator[Measurement]:
        """Iterate over every measurement from now on, in order and once, also those from before a command.

        While this program does something else, the newest eight wait for it; `overtaken` counts those that did not.
        Frames that the instrument skipped for lack of time are in `measurement.counts` only.
        """
        return self._until_failure(self._connection.frames.every())

    @property
    def overtaken(self) -> int:
        """Number of measurements that the instrument replaced before, or while, this program read them."""
        return self._connection.frames.overtaken

    def set_light(self, on: bool) -> None:
        """Switch the light, or note that you switched it by hand. Off works at once, for watching clients, too."""
        if on or self._bench.has_manual_light:
            super().set_light(on)
        else:
            self._result(self._connection.switch_light_off())

    @property
    def controller(self) -> str:
        """Name of the client that has control; empty if nobody has it."""
        return self._connection.controller

    @property
    def has_control(self) -> bool:
        """True while this program has control: the instrument executes its commands."""
        return self._connection.has_control

    @property
    def clients(self) -> tuple[str, ...]:
        """Names of all clients that are connected."""
        return self._connection.clients

    def take_control(self) -> None:
        """Take control from the client that has it."""
        self._result(self._connection.take_control())

    def require_ready(self) -> None:
        """Start the camera, once the instrument is ready; `RunError` if no frame can have a wavefront."""
        self._start_camera()
        status = self._status()
        if not status.is_calibrated:
            raise RunError(f"nothing was recorded: {status.warning}")
        if not status.is_light_on:
            raise RunError("nothing was recorded: the light is off; switch it on, as with L in svwfs live --attach")

    def shut_down(self) -> None:
        """End the instrument for everybody: light off, devices closed, recording finished."""
        self._connection.shut_down().result(_SHUT_DOWN_S)
