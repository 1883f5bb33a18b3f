"""The acquisition: a worker thread that owns the devices and executes commands between frames.

Every `Measurement` goes to the sinks in order; the newest also lies in a one-slot mailbox. No wait exceeds 0.1 s, so a
stop takes effect at once. If a device fails, all devices are closed, the light first, and `error` says why.
"""

import math
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, wait
from contextlib import closing, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import ParamSpec, TypeVar

from app.acquisition import devices as bench_devices
from app.acquisition.command_queue import CommandQueue, done
from app.acquisition.frame_path import FramePath, Sink, read_frame
from app.acquisition.instrument import Activity, Commands, Instrument, ProcessState, Status
from app.acquisition.streams.publisher import Publisher
from app.bench.config import Bench
from app.errors import InputError, RunError
from app.measurement.measurement import FrameTotals, LightState, Measurement
from app.measurement.routines import Cancelled, RoutineCallbacks
from app.progress import run_in_thread
from app.recording.recorder import Recorder, RecordingLimit, RecordingState
from app.timing import StageTimes, TimedStage, Timings
from drivers.interface import DeviceError, Frame, LightSource, OffCount
from reconstruction.runtime.threads import one_blas_thread

T = TypeVar("T")
P = ParamSpec("P")

# Of turns of Python threads: each waits for its turn after a system call, and a busy window would keep it for 5 ms.
_SWITCH_INTERVAL_S = 0.0005
_IDLE_S = 0.1  # longest wait for a command while no frames are taken
_STATUS_INTERVAL_S = 1.0  # polling also detects an unplugged light or a turned knob
_LIGHT_OFF_S = 3.0  # for a light that does not answer
# Without a sign of life in these times, the watchdog switches the light off.
_ALIVE_S = 1.5  # while the worker waits, and takes frames, ...
_ALIVE_FRAMES = 5  # ... or the time of so many frames, if they take longer
_COMMAND_S = 10.0  # a command, and each step of a routine: cameras change some settings slowly
_PREPARATION_S = 120.0  # of the reconstruction, and each of the first frames, which may compile
_FIRST_FRAMES = 5
_STATUS_SHARE = 0.1  # maximum share of the time spent polling: a slow light must not cost frames


class Acquisition(Commands):
    """The worker thread, with a recorder; it alone calls devices, but to switch the light off. Any thread may ask."""

    def __init__(
        self,
        bench: Bench,
        open_devices: bench_devices.OpenDevices | None = None,
        *,
        sinks: tuple[Sink, ...] = (),
        publisher: Publisher | None = None,
    ) -> None:
        """`sinks` receive every measurement; a `publisher` writes a ring for clients."""
        self.bench = bench  # as given; the instrument has the changed settings
        self._open_devices = open_devices or bench_devices.open_devices
        self._off_count = OffCount()  # of the light, also while it is opened
        self.commands: CommandQueue = CommandQueue(self._off_count, self._finish_command)
        self._stopping = threading.Event()
        self._cancelling = threading.Event()
        self._light: LightSource | None = None
        self._switching_off: list[Future[None]] = []  # requests under way
        self._dark_s = -math.inf  # when the light was last switched off by a request
        self._writing_status = threading.Lock()
        self._thread = threading.Thread(target=self._work, name="acquisition", daemon=True)
        self.timings = Timings()
        self._recorder = Recorder(self.timings)
        self._publisher = publisher or Publisher(bench)
        sinks = (self._recorder.take, *sinks, self._publisher.take)
        self._path = FramePath(
            sinks, self.timings, self._must_stop_waiting, partial(self._publisher.take, is_shown_only=True)
        )
        self.status: Status | None = None  # None until the devices are open
        self._status_due_s = -math.inf  # time of the next poll
        self._activity = Activity("opening the devices")
        self._keep_alive: Callable[[float], None] = lambda _: None
        self._first_frames = 0  # to come, after the last preparation
        self.error: Exception | None = None  # why the worker ended without being asked to

    def start(self) -> None:
        """Open the devices and begin to execute commands."""
        self._thread.start()

    def stage_times(self) -> Future[dict[TimedStage, StageTimes]]:
        """Find the statistics of the times of all stages; that takes milliseconds."""
        return run_in_thread(self.timings.summary, "stage times")[0]

    def cancel(self) -> Future[None]:
        """End the current routine, if any; it restores the devices."""
        self._cancelling.set()
        return done()

    def switch_light_off(self) -> Future[None]:
        """Switch the light off at once, bypassing the worker, and cancel the current routine.

        Commands that were sent before cannot switch it on again; the future resolves when it is off.
        """
        self._off_count.add()
        self.cancel()
        future, _ = run_in_thread(self._switch_off, "light off")
        self._switching_off = [*(each for each in self._switching_off if not each.done()), future]
        return future

    def _switch_off(self) -> None:
        if self._light is not None:  # else no device is open yet, and the count keeps the light off
            self._light.set_on(False)
        with self._writing_status:
            self._dark_s = time.monotonic()
            if self.status is not None:
                self.status = replace(self.status, is_light_on=False)

    def show_file(self, path: Path) -> Future[None]:
        """Stop the camera, and reconstruct and publish the frame of an image file, as if it came from there."""
        return self.show_single(lambda instrument: read_frame(path, instrument.devices.camera), path.name)

    def show_single(self, choose: Callable[[Instrument], Frame], file: str = "") -> Future[None]:
        """Stop the camera; reconstruct and publish the frame that `choose` returns.

        `file` names the file that it is read from, if that is no recording. Refused during a recording.
        """

        def command(instrument: Instrument) -> None:
            self._recorder.require_none(f"{file}: is not shown during a recording, of which it would be part")
            frame = choose(instrument)  # may refuse: the camera continues
            if file or instrument.bench.reconstruction.refine:  # which takes seconds
                self._activity = Activity("reconstructing the frame", may_cancel=False)
            instrument.devices.camera.stop()
            self._path.process_single(frame, instrument, self._light_state(), file)

        return self.commands.submit(command)

    def limit_recording(self, limit: RecordingLimit) -> Future[None]:
        """Replace the limit of the current recording, if any, and of one that waits for its start."""
        return self._now_and_in_turn(partial(self._recorder.limit, limit))

    def stop_recording(self) -> Future[None]:
        """End the current recording, if any, and one that waits for its start; it is finished soon after."""
        return self._now_and_in_turn(self._recorder.stop)

    def free_minutes(self, folder: Path) -> Future[float]:
        """Find the recording time left in a folder at the current rate; see `Recorder.free_minutes`."""
        return run_in_thread(partial(self._recorder.free_minutes, folder), "free space")[0]

    @property
    def recording(self) -> RecordingState | None:
        """State of the current or last recording; None before the first."""
        return self._recorder.state

    @property
    def kept(self) -> RecordingState | None:
        """State of the recording that `keep_recent` writes or wrote last."""
        return self._recorder.kept_state

    @property
    def failure(self) -> str:
        """`error` in words; empty while the worker runs or after it was asked to end."""
        if isinstance(self.error, DeviceError | InputError | RunError | None):
            return str(self.error or "")
        return f"{type(self.error).__name__}: {self.error}"

    @property
    def activity(self) -> Activity:
        """Work other than taking frames; also that the light does not answer, for which all of it waits."""
        if self._light is not None and self._light.is_silent:
            return Activity("the light does not answer", may_cancel=False)
        return self._activity

    @property
    def counts(self) -> FrameTotals:
        """Numbers of frames acquired, reconstructed and lost so far."""
        return self._path.counts

    @property
    def processes(self) -> tuple[ProcessState, ...]:
        """State of the processes that hold the light and search for layers, if any."""
        return () if self.status is None else self.status.processes

    @property
    def newest(self) -> Measurement | None:
        """The mailbox: the newest measurement."""
        return self._path.newest

    @property
    def is_alive(self) -> bool:
        """True if the worker still runs."""
        return self._thread.is_alive()

    @property
    def is_closing(self) -> bool:
        """True once the worker was asked to end."""
        return self._stopping.is_set()

    def begin_close(self) -> None:
        """Turn the light off at once and ask the worker to end."""
        if not self._stopping.is_set() and self._thread.is_alive():
            self.switch_light_off()
        self._stopping.set()

    def close(self, timeout_s: float | None = None) -> None:
        """Turn the light off, stop, finish the recording, close the devices, in `timeout_s` at most."""
        self.begin_close()
        if self._thread.is_alive():
            self._thread.join(timeout_s)
        wait(self._switching_off, _LIGHT_OFF_S if timeout_s is None else timeout_s)

    def _now_and_in_turn(self, act: Callable[[], None]) -> Future[None]:
        """Act at once, and again behind the commands that wait: one of them may start a recording."""
        act()
        self.commands.submit(lambda _: act())  # refused at the end, when no recording can start
        return done()

    def _work(self) -> None:
        sys.setswitchinterval(_SWITCH_INTERVAL_S)
        try:
            with (
                one_blas_thread(),
                self._publisher.running(),
                self._open_devices(self.bench, self._show_opening) as devices,
                closing(
                    Instrument(
                        devices,
                        self.bench,
                        recorder=self._recorder,
                        timings=self.timings,
                        show_preparation=self._show_preparation,
                        callbacks=self._callbacks,
                    )
                ) as instrument,
            ):
                devices.light.off_count, self._light = self._off_count, devices.light
                self._keep_alive = devices.light.keep_alive
                self._activity = Activity()
                self._update_status(instrument)
                while not self._stopping.is_set():
                    self._keep_alive(_ALIVE_S)
                    execute = self.commands.next(0.0 if devices.camera.is_running else _IDLE_S)
                    while execute is not None:  # also at the end: the light stays off, and none is refused
                        self._keep_alive(_COMMAND_S)
                        with self.timings.of("command"):
                            execute(instrument)
                        execute = self.commands.next()
                    if not devices.camera.is_running:
                        self._poll_status(instrument)
                    else:
                        self._show_alive()
                        with suppress(Cancelled):  # to execute a command, or to stop
                            self._path.acquire(instrument, self._light_state())
                            self._first_frames = max(self._first_frames - 1, 0)
        except Cancelled:
            pass
        except (DeviceError, InputError, RunError) as error:
            self.error = error
        except Exception as error:
            self.error = error
            # At interpreter exit the worker pool ends before a worker that was given up: not a fault.
            if not (isinstance(error, RuntimeError) and self._stopping.is_set()):
                raise
        finally:
            self.commands.close(self.failure or "the acquisition has ended")
            self._recorder.close(self.failure)
            self._activity = Activity()

    def _show_opening(self, fraction: float) -> None:
        if self._stopping.is_set():
            raise Cancelled
        self._activity = Activity("preparing the devices", fraction)

    def _show_preparation(self, what: str) -> None:
        """Show that the reconstruction is prepared, which cannot be cancelled, nor begun at the end."""
        if self._stopping.is_set():
            raise Cancelled
        self._keep_alive(_PREPARATION_S)
        self._first_frames = _FIRST_FRAMES
        self._activity = Activity(what, may_cancel=False)
        self._path.gap_cause = what

    def _callbacks(self, instrument: Instrument, text: str) -> RoutineCallbacks:
        def show_progress(frame: Frame, fraction: float) -> None:
            self._activity = Activity(text, fraction)
            self._path.show(frame, text, self._light_state())

        def should_stop() -> bool:
            self._keep_alive(_COMMAND_S)
            self._poll_status(instrument)  # the light and the sample differ from before
            return self._stopping.is_set() or self._cancelling.is_set()

        self._cancelling.clear()
        self._status_due_s = -math.inf
        self._activity = Activity(text)
        self._path.gap_cause = text
        return RoutineCallbacks(show_progress, should_stop)

    def _show_alive(self) -> None:
        frames_s = min(_ALIVE_FRAMES * self._path.measured_in_s, _PREPARATION_S)
        self._keep_alive(_PREPARATION_S if self._first_frames else max(_ALIVE_S, frames_s))

    def _finish_command(self, instrument: Instrument) -> None:
        self._update_status(instrument)
        self._activity = Activity()  # not before: the status is still that of the routine, for example the light off

    def _must_stop_waiting(self, instrument: Instrument) -> bool:
        """Return whether the worker should stop waiting for a frame; also polls the status in long exposures."""
        self._show_alive()
        self._poll_status(instrument)
        return self._stopping.is_set() or not self.commands.is_empty

    def _poll_status(self, instrument: Instrument) -> None:
        if time.monotonic() > self._status_due_s:
            self._update_status(instrument)

    def _update_status(self, instrument: Instrument) -> None:
        asked_s = time.monotonic()
        status, answered_s = instrument.status(), time.monotonic()
        with self._writing_status:
            self.status = replace(status, is_light_on=False) if self._dark_s >= asked_s else status
        self._status_due_s = answered_s + max(_STATUS_INTERVAL_S, (answered_s - asked_s) / _STATUS_SHARE)

    def _light_state(self) -> LightState | None:
        return None if self.status is None else LightState(self.status.is_light_on, self.status.current_a)
