"""Common base of all devices: name, properties, connection state, ranges, discovery.

Each driver offers `discover() -> tuple[DiscoveredDevice, ...]`. It changes nothing, switches nothing on, and raises
`Unsupported`, naming what is missing, if it cannot search.
"""

import threading
from abc import ABC, abstractmethod
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Literal, Self, TypeAlias

import numpy as np

from drivers.errors import BadValue, Disconnected, WrongState

Property: TypeAlias = str | float | int | bool


class Device(ABC):
    """An open device, called by one thread; only a light may be switched off by any other.

    After the first `Disconnected` the device is lost: every later call raises it again, until the device is closed and
    reopened. A driver's own methods raise only `DeviceError`.
    """

    def __init__(self, kind: str) -> None:
        """`kind` names the device in errors: camera, light or stage."""
        self._kind = kind
        self._name = ""  # set by the driver
        self._is_closed = False
        self._loss = ""  # message of the first `Disconnected`
        self._lock = threading.RLock()  # at exit the interpreter closes devices from another thread

    @property
    def name(self) -> str:
        """Maker, model and serial number; also known after a loss."""
        return self._name

    def properties(self) -> dict[str, Property]:
        """Everything that the device reports about itself and its settings, for the record."""
        return {"name": self.name}

    @abstractmethod
    def _close(self) -> None:
        """Leave the device in a safe state and release it; called once, in any state."""

    def close(self) -> None:
        """Leave the device in a safe state and release it; closing twice is allowed."""
        if self._is_closed:
            return
        try:
            self._close()
        except Disconnected:  # nothing left to release
            pass
        finally:
            self._is_closed = True

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @contextmanager
    def _access(self) -> Iterator[None]:
        """Lock the device; raise if it is closed or lost, and remember a new loss."""
        with self._lock:
            if self._is_closed:
                raise WrongState(f"the {self._kind} is closed")
            if self._loss:
                raise Disconnected(self._loss)
            try:
                yield
            except Disconnected as error:
                self._loss = str(error)
                raise


@dataclass(frozen=True, slots=True)
class Range:
    """Closed interval of allowed values, in the unit of its setting."""

    minimum: float
    maximum: float

    def check(self, value: float, what: str) -> float:
        """Return `value` if it is in the interval, else raise `BadValue` naming `what` and the interval."""
        if not self.minimum <= value <= self.maximum:  # false for NaN, too
            raise BadValue(f"{what} = {value:g} is outside {self.minimum:g} ... {self.maximum:g}")
        return value

    def nearest(self, value: float) -> float:
        """Return the allowed value that is nearest to `value`."""
        return min(max(value, self.minimum), self.maximum)


def switched(on: object) -> bool:
    """Return the state for a switch; `BadValue` unless it is True or False: "off" would switch it on."""
    if not isinstance(on, bool | np.bool_):
        raise BadValue(f"a switch takes True or False, not {on!r:.40}")
    return bool(on)


def choose(wanted: str, devices: Sequence[Collection[str]], *, what: str, setting: str) -> int:
    """Return the place of the device that has the wanted name, "" for the only one; errors name the `setting`."""
    fitting = [place for place, names in enumerate(devices) if wanted in {"", *names}]
    if len(fitting) == 1:
        return fitting[0]
    listed = ", ".join(" or ".join(names) for names in devices)
    if fitting:
        raise BadValue(f"there are {len(fitting)} {what}s; say which by {setting}: {listed}")
    others = f"; there are {listed}" if devices else ": none answers"
    raise Disconnected(f"there is no {what} {wanted}".rstrip() + others)


@dataclass(frozen=True, slots=True, kw_only=True)
class DiscoveredDevice:
    """A connected device and the bench settings that select it."""

    kind: Literal["camera", "light"]
    driver: str  # name in a bench
    description: str  # maker, model and serial number, as far as known without opening it
    settings: Mapping[str, str | int] = field(default_factory=dict)  # keys of the bench's section
    is_certain: bool = True  # False for a serial port that could belong to another device
    missing: str = ""  # what prevents its use, such as a permission or a cable

    @property
    def name(self) -> str:
        """Argument for `svwfs devices --check`."""
        return ":".join([self.driver, *map(str, self.settings.values())])
