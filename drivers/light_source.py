"""What every light offers, and what keeps it safe whichever it is.

It is off after it was opened, after it was closed, after any fault, and when the interpreter ends; its current goes up
in steps and never above what its head and its owner allow. A driver fills in the methods with a leading underscore.
"""

from __future__ import annotations

import atexit
import time
from abc import abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from weakref import WeakSet

import numpy as np

from drivers.camera import Range
from drivers.device import Device
from drivers.errors import BadValue, DeviceError, Disconnected, Unsupported, WrongState

_RAMP_STEPS = 8  # from the lowest to the highest current
_RAMP_S = 0.08
_REFUSALS = (BadValue, Unsupported, WrongState)  # nothing happened: no reason to switch off


class LightSource(Device):
    """A light with an adjustable current. It is off after it was opened and after it was closed."""

    def __init__(self, *, limit_a: float | None = None, sleep: Callable[[float], None] = time.sleep) -> None:
        """`limit_a` is the owner's limit of the current, below the head's own."""
        super().__init__("light")
        self._limit_a, self._sleep = limit_a, sleep
        self._lit_since_s: float | None = None
        self._lit_before_s = 0.0

    def _begin(self) -> None:
        """Make it safe; the driver's constructor calls this last."""
        self._switch(on=False)
        _open_lights.add(self)

    @property
    def current_range_a(self) -> Range:
        """The currents that driver, head and owner allow."""
        with self._guarded():
            return self._range()

    @property
    def current_a(self) -> float:
        """The current that flows when the light is on."""
        with self._guarded():
            return self._read_current()

    def set_current(self, current_a: float) -> float:
        """Change the current, in steps when the light is on and it goes up; return the one in force."""
        with self._guarded():
            allowed = self._range()
            allowed.check(current_a, "current_a")
            return self._ramp(current_a, allowed) if self._is_lit() else self._set_current(current_a)

    @property
    def is_on(self) -> bool:
        """Whether the light is lit."""
        with self._guarded():
            return self._is_lit()

    def set_on(self, on: bool) -> None:
        """Switch the light; the current comes up in steps."""
        with self._guarded():
            if not on or self._is_lit():
                self._switch(on=on)
            else:
                wanted_a, allowed = self._read_current(), self._range()
                self._set_current(min(wanted_a, allowed.minimum))
                self._switch(on=True)
                self._ramp(min(wanted_a, allowed.maximum), allowed)
            self._note(on=on)

    @property
    def lit_s(self) -> float:
        """How long the light has been on since it was opened, in all."""
        now_s = 0.0 if self._lit_since_s is None else time.monotonic() - self._lit_since_s
        return self._lit_before_s + now_s

    def close(self) -> None:
        """Switch off and let go; closing twice is allowed."""
        _open_lights.discard(self)
        if self._is_closed:
            return
        self._note(on=False)
        try:
            if not self._loss:
                with suppress(Disconnected):
                    self._switch(on=False)
        finally:
            super().close()

    def _range(self) -> Range:
        head = self._read_range()
        return head if self._limit_a is None else Range(head.minimum, min(head.maximum, self._limit_a))

    def _ramp(self, current_a: float, allowed: Range) -> float:
        start_a = self._read_current()
        steps = int(np.ceil(_RAMP_STEPS * (current_a - start_a) / max(allowed.maximum - allowed.minimum, 1e-12)))
        for step_a in np.linspace(start_a, current_a, max(steps, 1) + 1)[1:-1]:
            self._set_current(float(step_a))
            self._sleep(_RAMP_S / _RAMP_STEPS)
        return self._set_current(current_a)

    def _note(self, *, on: bool) -> None:
        """Let the timer run, or hold it."""
        self._lit_before_s = self.lit_s
        self._lit_since_s = time.monotonic() if on else None

    @contextmanager
    def _guarded(self) -> Iterator[None]:
        """Speak to the light; after a fault, whichever it is, it is switched off."""
        with self._talking():
            try:
                yield
            except _REFUSALS:
                raise
            except DeviceError:
                self._note(on=False)
                with suppress(DeviceError):
                    self._switch(on=False)
                raise

    @abstractmethod
    def _read_range(self) -> Range:
        """The currents that driver and head allow."""

    @abstractmethod
    def _read_current(self) -> float: ...

    @abstractmethod
    def _set_current(self, current_a: float) -> float: ...

    @abstractmethod
    def _is_lit(self) -> bool: ...

    @abstractmethod
    def _switch(self, *, on: bool) -> None: ...


_open_lights: WeakSet[LightSource] = WeakSet()


@atexit.register
def _switch_all_off() -> None:
    """Leave no light on when the interpreter ends, however that comes."""
    for light in tuple(_open_lights):
        with suppress(Exception):
            light.close()
