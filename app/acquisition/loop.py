"""The acquisition loop: one worker thread that owns the devices and executes commands between frames.

Every `Measurement` goes to the sinks in order; the newest also lies in a one-slot mailbox. No wait exceeds 0.1 s, so a
stop takes effect at once. If a device fails, all devices are closed, the light first, and `error` says why.
"""

import math
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from typing import TypeVar

from app.acquisition.command_queue import CommandQueue
from app.acquisition.frame_path import FramePath
from app.acquisition.instrument import Instrument, Status
from app.acquisition.light_switch import LightSwitch
from app.bench.config import Bench
from app.errors import InputError, RunError
from app.measurement.measurement import FrameTotals, LightState, Measurement
from app.measurement.routines import WAIT_SLICE_S, Cancelled
from app.recording.recorder import Recorder
from app.timing import Timings, short_turns
from drivers.interface import DeviceError, Devices
from reconstruction.runtime.threads import one_blas_thread

T = TypeVar("T")

_STATUS_INTERVAL_S = 1.0  # polling also detects an unplugged light or a turned knob
_LIGHT_OFF_S = 3.0  # for a light that does not answer
_STATUS_SHARE = 0.1  # maximum share of the time spent polling: a slow light must not cost frames


@dataclass(frozen=True, slots=True)
class Activity:
    """Work besides taking frames, with its progress; empty text if there is none."""

    text: str = ""
    progress: float = 0.0
    may_cancel: bool = True


class AcquisitionLoop:
    """The worker thread; it calls `open_devices(bench, progress)` and everything else that touches a device."""

    def __init__(
        self,
        bench: Bench,
        open_devices: Callable[[Bench, Callable[[float], None]], Devices],
        sinks: tuple[Callable[[Measurement], None], ...] = (),
    ) -> None:
        self.bench = bench  # as given; the instrument has the changed settings
        self._open_devices = open_devices
        self._commands = CommandQueue(self._finish_command)
        self._stopping = threading.Event()
        self._cancelling = threading.Event()
        self._light_switch = LightSwitch()
        self._writing_status = threading.Lock()
        self._thread = threading.Thread(target=self._work, name="acquisition", daemon=True)
        self.timings = Timings()
        self._recorder = Recorder(self.timings)
        self._path = FramePath((self._recorder.take, *sinks), self.timings, self._must_stop_waiting)
        self.status: Status | None = None  # None until the devices are open
        self._status_due_s = -math.inf  # time of the next poll
        self.activity = Activity("opening the devices")
        self.error: Exception | None = None  # why the worker ended without being asked to

    def start(self) -> None:
        """Open the devices and begin to execute commands."""
        self._thread.start()

    def submit(self, command: Callable[[Instrument], T]) -> Future[T]:
        """Execute `command` on the worker between two frames; the future resolves after `status` is updated."""
        known = self._light_switch.requests

        def execute(instrument: Instrument) -> T:
            self._light_switch.begin_command(known)
            return command(instrument)

        return self._commands.submit(execute)

    def cancel(self) -> None:
        """End the current routine, if any; it restores the devices."""
        self._cancelling.set()

    def switch_light_off(self) -> Future[None]:
        """Switch the light off at once, beside the worker, and cancel the current routine.

        Commands that were sent before cannot switch it on again; the future resolves when it is off.
        """
        future = self._light_switch.switch_off()
        self.cancel()
        future.add_done_callback(self._note_light_off)
        return future

    def close(self, timeout_s: float | None = None) -> None:
        """Turn the light off, stop, finish the recording, close the devices; wait at most `timeout_s` for all that."""
        self.begin_close()
        if self._thread.is_alive():
            self._thread.join(timeout_s)
        self._light_switch.close(_LIGHT_OFF_S if timeout_s is None else timeout_s)

    def begin_close(self) -> None:
        """Turn the light off at once and ask the worker to end."""
        if not self._stopping.is_set() and self._thread.is_alive():
            self.switch_light_off()
        self._stopping.set()

    @property
    def failure(self) -> str:
        """`error` in words; empty while the worker runs or after it was asked to end."""
        if isinstance(self.error, DeviceError | InputError | RunError | None):
            return str(self.error or "")
        return f"{type(self.error).__name__}: {self.error}"

    @property
    def counts(self) -> FrameTotals:
        """Numbers of frames acquired, reconstructed and lost so far."""
        return self._path.counts

    @property
    def newest(self) -> Measurement | None:
        """The mailbox: the newest measurement."""
        return self._path.newest

    @property
    def is_alive(self) -> bool:
        """True if the worker still runs."""
        return self._thread.is_alive()

    def _work(self) -> None:
        try:
            with (
                one_blas_thread(),
                short_turns(),
                self._open_devices(self.bench, self._show_opening) as devices,
                closing(Instrument(devices, self.bench, self.timings, self._show_preparation)) as instrument,
            ):
                self._light_switch.attach(devices.light)
                self.activity = Activity()
                self._update_status(instrument)
                while not self._stopping.is_set():
                    self._execute_commands(instrument, wait=not devices.camera.is_running)
                    if not devices.camera.is_running:
                        self._poll_status(instrument)
                    else:
                        with suppress(Cancelled):  # to execute a command, or to stop
                            self._path.acquire(instrument, self._light())
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
            self._commands.close(self.failure or "the acquisition has ended")
            self._recorder.close(self.failure)
            self.activity = Activity()

    def _show_opening(self, fraction: float) -> None:
        if self._stopping.is_set():
            raise Cancelled
        self.activity = Activity("preparing the devices", fraction)

    def _show_preparation(self, what: str) -> None:
        """Show that the instrument prepares the reconstruction; this cannot be cancelled, and at the end not begun."""
        if self._stopping.is_set():
            raise Cancelled
        self.activity = Activity(what, may_cancel=False)
        self._path.gap_cause = what

    def _execute_commands(self, instrument: Instrument, *, wait: bool) -> None:
        execute = self._commands.next(WAIT_SLICE_S if wait else 0.0)
        while execute is not None:
            execute(instrument)
            execute = self._commands.next()

    def _finish_command(self, instrument: Instrument) -> None:
        self._update_status(instrument)
        self.activity = Activity()  # not before: the status is still that of the routine, for example the light off

    def _must_stop_waiting(self, instrument: Instrument) -> bool:
        """Return whether the worker should stop waiting for a frame; also polls the status in long exposures."""
        self._poll_status(instrument)
        return self._stopping.is_set() or not self._commands.is_empty

    def _poll_status(self, instrument: Instrument) -> None:
        if time.monotonic() > self._status_due_s:
            self._update_status(instrument)

    def _update_status(self, instrument: Instrument) -> None:
        asked_s, served = time.monotonic(), self._light_switch.served
        status, answered_s = instrument.status(), time.monotonic()
        with self._writing_status:
            if served != self._light_switch.served:  # switched off while the status was queried
                status = replace(status, is_light_on=False)
            self.status = status
        self._status_due_s = answered_s + max(_STATUS_INTERVAL_S, (answered_s - asked_s) / _STATUS_SHARE)

    def _note_light_off(self, future: Future[None]) -> None:
        with self._writing_status:
            if future.exception() is None and self.status is not None:
                self.status = replace(self.status, is_light_on=False)

    def _light(self) -> LightState | None:
        return None if self.status is None else LightState(self.status.is_light_on, self.status.current_a)
