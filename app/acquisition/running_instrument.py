"""Interface of a running instrument, in this process or in another, to window, commands and scripts."""

from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path
from typing import Concatenate, ParamSpec, Protocol, TypeVar

from app.acquisition.instrument import Instrument, ProcessState, Status
from app.bench.config import Bench
from app.measurement.measurement import FrameTotals, Measurement
from app.measurement.sensor_region import SensorArea
from app.recording.recorder import RecordingLimit, RecordingState
from app.timing import Timings

T = TypeVar("T")
P = ParamSpec("P")

CLOSING_S = 45.0  # until a closed instrument ends: a frame of the slowest method takes up to half of it
WINDOW = "live"  # command of the recordings of a window, and of those that name none


@dataclass(frozen=True, slots=True)
class Activity:
    """Work besides taking frames, with its progress; empty text if there is none."""

    text: str = ""
    progress: float = 0.0
    may_cancel: bool = True


class RunningInstrument(Protocol):
    """An instrument in this process, an `Acquisition`, or in another, to which a `Connection` leads.

    Requests may come from any thread and return at once, with a future.
    """

    @property
    def bench(self) -> Bench: ...  # as given; the status has the changed settings
    @property
    def timings(self) -> Timings: ...
    @property
    def status(self) -> Status | None: ...  # None until the devices are open
    @property
    def processes(self) -> tuple[ProcessState, ...]: ...
    @property
    def activity(self) -> Activity: ...
    @property
    def error(self) -> Exception | None: ...  # why it ended without being asked to
    @property
    def failure(self) -> str: ...
    @property
    def counts(self) -> FrameTotals: ...
    @property
    def newest(self) -> Measurement | None: ...
    @property
    def recording(self) -> RecordingState | None: ...
    @property
    def kept(self) -> RecordingState | None: ...
    @property
    def is_alive(self) -> bool: ...

    def start(self) -> None: ...
    def submit(
        self, request: Callable[Concatenate[Instrument, P], T], *arguments: P.args, **named: P.kwargs
    ) -> Future[T]: ...
    def cancel(self) -> Future[None]: ...
    def switch_light_off(self) -> Future[None]: ...
    def set_area(self, area: SensorArea) -> Future[SensorArea]: ...
    def show_file(self, path: Path) -> Future[None]: ...
    def start_recording(
        self, folder: Path, *, command: str = ..., limit: RecordingLimit = ..., may_rename: bool = ...
    ) -> Future[None]: ...
    def limit_recording(self, limit: RecordingLimit) -> Future[None]: ...
    def stop_recording(self) -> Future[None]: ...
    def keep_recent(self, folder: Path, *, may_rename: bool = ...) -> Future[None]: ...
    def free_minutes(self, folder: Path) -> Future[float]: ...
    def begin_close(self) -> None: ...
    def close(self, timeout_s: float | None = None) -> None: ...
