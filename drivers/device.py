"""Common base of all devices: name, properties, connection state."""

import threading
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Self, TypeAlias

from drivers.errors import Disconnected, WrongState

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
