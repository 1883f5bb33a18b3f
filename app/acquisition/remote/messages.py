"""Messages between an instrument and its clients, and objects that travel by themselves."""

import math
import threading
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

from app.acquisition.instrument import Activity, ProcessState, Status
from app.acquisition.remote.serialization import Absent
from app.bench.config import Bench
from app.errors import InputError, RunError
from app.measurement.calibration import Calibration
from app.measurement.measurement import FrameTotals, Measurement
from app.measurement.routines import Cancelled, RoutineError
from app.recording.recorder import RecordingState
from drivers import errors
from reconstruction.errors import ReconstructionError
from reconstruction.registration.gauss_newton import Propagated

MOST_BYTES = 2**28  # of a message to the instrument: a calibration of 2048 x 2048 pixels has a third
_KEPT = 8  # objects; in use are two or three
_ERRORS = (
    *(errors.BadValue, errors.Busy, errors.DeviceError, errors.DeviceTimeout, errors.Disconnected),
    *(errors.FrameLost, errors.Unsupported, errors.WrongState),
    *(InputError, RunError, Cancelled, RoutineError, ReconstructionError),
)


def watching(controller: str) -> str:
    """Say why commands of a client are refused: who has control, empty if nobody."""
    return f"this program only watches: {controller or 'nobody'} has control; take control first"


@dataclass(frozen=True, slots=True)
class Hello:
    """A client enters, takes control if it may and nobody has it, and reads every `pause_s`."""

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


class Heartbeat(Enum):
    """A message that is one word."""

    ALIVE = "a client lives and reads"
    BYE = "a client leaves"
    FORGOTTEN = "a client was silent for too long: it may say hello again"


def portable_error(error: BaseException) -> Exception:
    """Return an error as a client gets it; an unexpected one is a `RunError` with its name."""
    known = next((kind for kind in type(error).__mro__ if kind in _ERRORS), None)
    return RunError(f"{type(error).__name__}: {error}") if known is None else known(str(error))


@dataclass(frozen=True, slots=True)
class State:
    """Everything about the instrument but its frames."""

    bench: Bench  # as given
    status: Status | None
    processes: tuple[ProcessState, ...]  # that it has started
    activity: Activity
    counts: FrameTotals
    recording: RecordingState | None
    kept: RecordingState | None
    ended_by: Exception | None = field(compare=False)
    is_alive: bool
    clients: tuple[str, ...]
    controller: str  # name of the client that has control; empty: nobody


@dataclass(frozen=True, slots=True)
class NewFrame:
    """The count of the newest record, in the ring of a name."""

    ring: str
    count: int


@dataclass(frozen=True, slots=True)
class RingRecord:
    """One record of the ring: a measurement without what the client computes itself."""

    measurement: Measurement  # without wavefront; it has a problem if it had no wavefront
    is_shown_only: bool  # a routine's frame


@dataclass(frozen=True, slots=True)
class Accepted:
    """A command has arrived and will be executed."""

    number: int


@dataclass(frozen=True, slots=True)
class Answer:
    """Result or error of a command, after the state then, with the count of the newest frame."""

    number: int
    result: Any
    error: Exception | None
    count: int


@dataclass(frozen=True, slots=True)
class SharedObject:
    """An object, sent before any message with its number, and the numbers that still occur."""

    number: int
    value: Any
    kept: tuple[int, ...]


class SharedObjects:
    """Numbers the objects that travel by themselves, and keeps the latest; used by two threads."""

    def __init__(self) -> None:
        self._last, self._lock = 0, threading.Lock()
        self._numbered: OrderedDict[int, tuple[int, Any]] = OrderedDict()  # by id, which objects kept do not lose
        self._seen: OrderedDict[int, Any] = OrderedDict()

    def number(self, value: object) -> int | None:
        """The number of a bench or calibration, and of the errors of a reference once they come again."""
        if not isinstance(value, Bench | Calibration | Propagated):
            return None
        with self._lock:
            if found := self._numbered.get(id(value)):
                self._numbered.move_to_end(id(value))
                return found[0]
            if isinstance(value, Propagated) and id(value) not in self._seen:  # with lost pixels, of one frame only
                self._seen[id(value)] = value
                _trim(self._seen)
                return None
            self._last += 1
            self._numbered[id(value)] = self._last, value
            _trim(self._numbered)
            return self._last

    def after(self, number: int) -> list[SharedObject]:
        """The objects with higher numbers, in their order."""
        with self._lock:
            kept = sorted(self._numbered.values(), key=lambda each: each[0])
        numbers = tuple(each for each, _ in kept)
        return [SharedObject(each, value, numbers) for each, value in kept if each > number]


class Arrivals:
    """A client's end of that: the objects that have arrived. One thread keeps them, two find them."""

    def __init__(self) -> None:
        self._objects: dict[int, Any] = {}

    def keep(self, shared: SharedObject) -> None:
        """Keep an object, unless it is there already, and those that still occur in messages."""
        known = {shared.number: shared.value} | self._objects
        self._objects = {number: value for number, value in known.items() if number in shared.kept}

    def find(self, number: int) -> Any:
        """Return the object of a number; raise `Absent` if it has not arrived."""
        if number not in (objects := self._objects):
            raise Absent(number)
        return objects[number]


def _trim(kept: OrderedDict[int, Any]) -> None:
    while len(kept) > _KEPT:
        kept.popitem(last=False)
