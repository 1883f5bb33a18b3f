"""The acquisition loop: one worker thread that owns the devices.

Everybody else sends it commands, which it executes between frames, and takes results: every `Measurement` goes to the
sinks in order, the newest one also lies in a one-slot mailbox for whoever only looks from time to time. No wait is
longer than a tenth of a second, so that a stop takes effect at once. When a device fails the devices are closed, the
light first, and the failure is there to be read.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from app.acquisition.command_queue import CommandQueue
from app.acquisition.frame_path import FramePath
from app.acquisition.instrument import Instrument, Status
from app.bench.config import Bench, write_bench
from app.errors import InputError, RunError
from app.measurement.measurement import Counts, LightState, Measurement
from app.measurement.routines import WAIT_SLICE_S, AutoExposure, BackgroundCheck, Cancelled
from app.measurement.sensor_region import SensorArea
from app.recording.background import RecordingState
from app.recording.recorder import Recorder
from app.timing import Timings, short_turns
from drivers.interface import DeviceError, Devices, Frame, WrongState
from reconstruction.runtime.threads import one_blas_thread

T = TypeVar("T")

__all__ = ["Acquisition", "Activity", "Counts", "Measurement"]


@dataclass(frozen=True, slots=True)
class Activity:
    """What the worker is busy with beside taking frames; empty text when with nothing."""

    text: str = ""
    progress: float = 0.0


class Acquisition:
    """The worker thread; `open_devices(bench, progress)` is called on it, as is everything that touches a device."""

    def __init__(
        self,
        bench: Bench,
        open_devices: Callable[[Bench, Callable[[float], None]], Devices],
        sinks: tuple[Callable[[Measurement], None], ...] = (),
    ) -> None:
        self._bench, self._open_devices = bench, open_devices
        self._commands = CommandQueue(self._show_status)
        self._stopping = threading.Event()
        self._cancelling = threading.Event()
        self._thread = threading.Thread(target=self._work, name="acquisition", daemon=True)
        self.timings = Timings()
        self._recorder = Recorder(self.timings)
        self._path = FramePath((self._recorder.take, *sinks), self.timings, self._is_wanted)
        self.status: Status | None = None  # None until the devices are open
        self._status_due_s = -math.inf  # when the devices are asked for it again
        self.activity = Activity("opening the devices")
        self.error: Exception | None = None  # why the worker has ended, when it was not asked to

    @property
    def bench(self) -> Bench:
        """What it was made for; settings that were changed since are the instrument's."""
        return self._bench

    def start(self) -> None:
        """Open the devices and begin to execute commands."""
        self._thread.start()

    def close(self, timeout_s: float | None = None) -> None:
        """Stop at once, turn the light off, close the devices and wait, at most `timeout_s`, for the worker to end.

        A recording is finished before.
        """
        self._stopping.set()
        if self._thread.is_alive():
            self._thread.join(timeout_s)

    @property
    def failure(self) -> str:
        """Why the worker has ended, in words; empty when it runs or was asked to end."""
        if isinstance(self.error, DeviceError | InputError | RunError | None):
            return str(self.error or "")
        return f"{type(self.error).__name__}: {self.error}"

    @property
    def counts(self) -> Counts:
        """What has become of the frames so far."""
        return self._path.counts

    @property
    def newest(self) -> Measurement | None:
        """The mailbox: what came last, for whoever only looks from time to time."""
        return self._path.newest

    @property
    def is_alive(self) -> bool:
        """Whether the worker still runs."""
        return self._thread.is_alive()

    def submit(self, command: Callable[[Instrument], T]) -> Future[T]:
        """Have the worker execute `command` between two frames; its result or error comes by the future.

        `status` tells of it by then.
        """
        return self._commands.submit(command)

    def take_dark(self, frames: int) -> Future[None]:
        """Have a dark taken, with its progress shown as activity."""
        return self._routine(
            f"taking the dark, {frames} frames", lambda instrument, **how: instrument.take_dark(frames, **how)
        )

    def take_reference(self, frames: int) -> Future[None]:
        """Have a reference taken, with its progress shown as activity."""
        return self._routine(
            f"taking the reference, {frames} frames", lambda instrument, **how: instrument.take_reference(frames, **how)
        )

    def auto_expose(self) -> Future[AutoExposure]:
        """Have exposure and current found and used; `RoutineError` says why there are none."""
        return self._routine("finding the exposure", lambda instrument, **how: instrument.auto_expose(**how))

    def check_background(self, frames: int = 8) -> Future[BackgroundCheck]:
        """Have the background compared with the dark; the result's `verdict` is for the person at the bench."""
        return self._routine(
            f"checking the background, {frames} frames",
            lambda instrument, **how: instrument.check_background(frames, **how),
        )

    def read_out(self, area: SensorArea) -> Future[SensorArea]:
        """Have another part of the sensor read out; see `Instrument.read_out`.

        It is refused while a recording is under way: one recording's frames are all alike. For the same reason the
        last seconds begin anew.
        """

        def command(instrument: Instrument) -> SensorArea:
            if self.recording is not None and self.recording.stage == "recording":
                raise WrongState("a recording is under way, and its frames must all be alike: stop it first")
            before, taken = SensorArea.of(instrument.devices.camera), instrument.read_out(area)
            if taken != before:
                self._recorder.forget_recent()
            return taken

        return self.submit(command)

    def start_recording(
        self, folder: Path, *, command: str = "live", frames: int | None = None, may_rename: bool = False
    ) -> Future[None]:
        """Record every frame from now on into a folder: `frames` of them, or until the recording is stopped.

        Where the folder is there already, `may_rename` has another one beside it made; `recording` tells which.

        The future has an `InputError` when the folder, or the time, is not free for it. What happens later, a full disk
        for one, is told by `recording`; the frames go on all the same.
        """
        return self.submit(
            lambda instrument: self._recorder.start(
                folder, _facts(instrument, command), frames=frames, may_rename=may_rename
            )
        )

    def stop_recording(self) -> None:
        """End the recording that is under way, if any; it is finished soon after."""
        self._recorder.stop()

    def keep_recent(self, folder: Path, *, command: str = "live", may_rename: bool = False) -> Future[None]:
        """Write the last ten seconds as a recording, whether or not one is under way; see `start_recording`."""
        return self.submit(
            lambda instrument: self._recorder.keep_recent(folder, _facts(instrument, command), may_rename=may_rename)
        )

    def free_minutes(self, folder: Path) -> float:
        """How long could be recorded into a folder at the rate of now; see `Recorder.free_minutes`."""
        return self._recorder.free_minutes(folder)

    @property
    def recording(self) -> RecordingState | None:
        """How the recording stands that is under way, or the last one; None before the first."""
        return self._recorder.state

    @property
    def kept(self) -> RecordingState | None:
        """Likewise of the seconds that were kept last."""
        return self._recorder.kept_state

    def cancel(self) -> None:
        """End the routine that is under way, if any; it leaves the devices as it found them."""
        self._cancelling.set()

    def _routine(self, text: str, routine: Callable[..., T]) -> Future[T]:
        def command(instrument: Instrument) -> T:
            self._cancelling.clear()
            self.activity = Activity(text)
            try:
                return routine(
                    instrument,
                    progress=lambda frame, fraction: self._show_progress(frame, text, fraction),
                    should_stop=lambda: self._stopping.is_set() or self._cancelling.is_set(),
                )
            finally:
                self.activity = Activity()

        return self.submit(command)

    def _show_progress(self, frame: Frame, text: str, fraction: float) -> None:
        """Let a frame that a routine takes be seen; it is neither measured nor counted."""
        self.activity = Activity(text, fraction)
        self._path.show(frame, text, self._light())

    def _work(self) -> None:
        try:
            with (
                one_blas_thread(),
                short_turns(),
                self._open_devices(self._bench, self._prepare) as devices,
                closing(Instrument(devices, self._bench, self.timings)) as instrument,
            ):
                self.activity = Activity()
                self._show_status(instrument)
                while not self._stopping.is_set():
                    self._execute_commands(instrument, wait=not devices.camera.is_running)
                    if not devices.camera.is_running:
                        self._keep_status(instrument)
                    else:
                        with suppress(Cancelled):  # a command, or the end, is waiting
                            self._path.acquire(instrument, self._light())
        except Cancelled:
            pass
        except (DeviceError, InputError, RunError) as error:
            self.error = error
        except Exception as error:
            self.error = error
            raise
        finally:
            self._end()

    def _prepare(self, fraction: float) -> None:
        """Show how far the devices are; opening them is given up here when the loop is to stop."""
        if self._stopping.is_set():
            raise Cancelled
        self.activity = Activity("preparing the devices", fraction)

    def _execute_commands(self, instrument: Instrument, *, wait: bool) -> None:
        """Execute what lies in the queue; `wait` a moment for something to come."""
        execute = self._commands.next(WAIT_SLICE_S if wait else 0.0)
        while execute is not None:
            execute(instrument)
            execute = self._commands.next()

    def _show_status(self, instrument: Instrument) -> None:
        asked_s = time.monotonic()
        self.status, answered_s = instrument.status(), time.monotonic()
        self._status_due_s = answered_s + max(_STATUS_INTERVAL_S, (answered_s - asked_s) / _STATUS_SHARE)

    def _keep_status(self, instrument: Instrument) -> None:
        """Ask the devices how they stand, when that is due."""
        if time.monotonic() > self._status_due_s:
            self._show_status(instrument)

    def _is_wanted(self, instrument: Instrument) -> bool:
        """Whether something else is to be done than to wait for frames; the status is kept in a long exposure, too."""
        self._keep_status(instrument)
        return self._stopping.is_set() or not self._commands.is_empty

    def _light(self) -> LightState | None:
        """The light as it was set last."""
        return None if self.status is None else LightState(self.status.is_light_on, self.status.current_a)

    def _end(self) -> None:
        """Finish what is being recorded; refuse all commands that nobody will execute any more."""
        self._commands.close(self.failure or "the acquisition has ended")
        self._recorder.close(self.failure)
        self.activity = Activity()


_STATUS_INTERVAL_S = 1.0  # the devices are asked so often: also a light's plug may be pulled, or its knob turned
_STATUS_SHARE = 0.1  # of the time at most: a light that is slow to answer must not cost the frames that come meanwhile


def _facts(instrument: Instrument, command: str) -> dict[str, Any]:
    """What a recording says of where it comes from."""
    return {
        "command": command,
        "bench": write_bench(instrument.bench),
        "devices": instrument.properties(),
    }
