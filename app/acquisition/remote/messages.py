"""Messages between an instrument and its clients."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from app.acquisition.instrument import Activity, Status
from app.bench.config import Bench
from app.errors import InputError, RunError
from app.measurement.measurement import FrameTotals
from app.measurement.routines import Cancelled, RoutineError
from app.recording.recorder import RecordingState
from drivers import errors
from reconstruction.errors import ReconstructionError

_OF_DEVICES = {each for each in vars(errors).values() if isinstance(each, type) and issubclass(each, Exception)}
_ERRORS: set[type] = _OF_DEVICES | {InputError, RunError, Cancelled, RoutineError, ReconstructionError}


def watching(controller: str) -> str:
    """Say why commands of a client are refused: who has control, empty if nobody."""
    return f"this program only watches: {controller or 'nobody'} has control; take control first"


@dataclass(frozen=True, slots=True)
class Hello:
    """A client lives, and reads every `pause_s`; one that enters may take control if nobody has it."""

    name: str
    takes_control: bool
    pause_s: float


@dataclass(frozen=True, slots=True)
class Command:
    """A request with its arguments; its answers have its number."""

    number: int
    request: str
    arguments: tuple[Any, ...] = ()
    named: Mapping[str, Any] = field(default_factory=dict)
    until_s: float = math.inf  # the latest begin, of `time.monotonic()`: soon after, its client gives it up


@dataclass(frozen=True, slots=True)
class Bye:
    """A client leaves."""


def portable_error(error: BaseException) -> Exception:
    """Return an error as a client gets it; an unexpected one is a `RunError` with its name."""
    known = next((kind for kind in type(error).__mro__ if kind in _ERRORS), None)
    return RunError(f"{type(error).__name__}: {error}") if known is None else known(str(error))


@dataclass(frozen=True, slots=True)
class NewStatus:
    """The status, and the bench as given; apart from `State`, because it takes forty times as long to read."""

    bench: Bench
    status: Status | None


@dataclass(frozen=True, slots=True)
class State:
    """State of the instrument in addition to its frames and its status."""

    activity: Activity
    counts: FrameTotals
    recording: RecordingState | None
    kept: RecordingState | None
    ended_by: Exception | None = field(compare=False)
    is_alive: bool
    clients: tuple[str, ...]
    controller: str  # name of the client that has control; empty: nobody
    ring_name: str  # of the newest ring of frames
    count: int  # of the measurements so far


@dataclass(frozen=True, slots=True)
class Answer:
    """Result or error of a command, after the state then, with the count of the newest frame."""

    number: int
    result: Any
    error: Exception | None
    count: int
