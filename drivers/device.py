"""What all devices have in common: a name, properties, and that they are open, lost or closed."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from types import TracebackType
from typing import Self, TypeAlias

from drivers.errors import Disconnected, WrongState

Property: TypeAlias = str | float | int | bool


class Device(ABC):
    """A device from its opening to its closing; only one thread calls it.

    A device that was found `Disconnected` is lost: every later call says so, until it is closed and opened anew.
    Whatever a driver's own methods meet leaves them as a `DeviceError`.
    """

    def __init__(self, what: str) -> None:
        """`what` it is called in errors: the camera, the light, the stage."""
        self._what = what
        self._is_closed = False
        self._loss = ""  # why it is gone
        self._turn = threading.RLock()  # against the interpreter's exit, which closes from another thread

    @property
    @abstractmethod
    def name(self) -> str:
        """Maker, model and serial number, as a person would say them; known from the opening on, also when lost."""

    def properties(self) -> dict[str, Property]:
        """All that the device can tell of itself and its settings, for the record."""
        return {"name": self.name}

    @abstractmethod
    def _close(self) -> None:
        """Leave the device safe and let go of it, whatever state it is in; called once."""

    def close(self) -> None:
        """Leave the device safe and let go of it; closing twice is allowed."""
        if self._is_closed:
            return
        try:
            self._close()
        except Disconnected:  # there is nothing left to let go of
            pass
        finally:
            self._is_closed = True

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @contextmanager
    def _talking(self) -> Iterator[None]:
        """Around everything that speaks to the device: not when it is closed or lost, and a loss is remembered."""
        with self._turn:
            if self._is_closed:
                raise WrongState(f"the {self._what} is closed")
            if self._loss:
                raise Disconnected(self._loss)
            try:
                yield
            except Disconnected as error:
                self._loss = str(error)
                raise
