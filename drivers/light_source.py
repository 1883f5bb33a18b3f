"""What every light offers, and what keeps it safe whichever it is.

It is off after it was opened, after it was closed, after any fault, and when the interpreter ends; its current goes up
in steps and never above what its head and its owner allow. A driver fills in the methods with a leading underscore.
"""

from __future__ import annotations

import atexit
import os
import sys
import time
from abc import abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from weakref import WeakSet

import numpy as np

from drivers.device import Device, Property
from drivers.errors import BadValue, DeviceError, Disconnected, Unsupported, WrongState
from drivers.range import Range

_RAMP_STEPS = 8  # from the lowest to the highest current
_RAMP_S = 0.08
_LAST_WAIT_S = 1.0  # before it is closed, for a thread that is talking to the light, and may hang
_REFUSALS = (BadValue, Unsupported, WrongState)  # nothing happened: no reason to switch off


class LightSource(Device):
    """A light with an adjustable current.

    A driver's constructor opens the connection and then calls `_begin`; whatever fails there closes it again.
    """

    def __init__(self, *, limit_a: float | None = None, sleep: Callable[[float], None] = time.sleep) -> None:
        """`limit_a` is the owner's limit of the current, below the head's own; `sleep` waits between two steps."""
        super().__init__("light")
        self._limit_a, self._sleep = limit_a, sleep
        self._has_begun = False  # before, nothing is known of what hangs on the wire, and nothing is sent to it
        self._lit_since_s: float | None = None
        self._lit_before_s = 0.0

    def _begin(self) -> None:
        """Make it safe: off, and set to a current that is allowed; the driver's constructor calls this last."""
        self._has_begun = True
        _open_lights.add(self)
        try:
            self._switch(on=False)
            allowed, current_a = self._range(), self._read_current()
            if not allowed.minimum <= current_a <= allowed.maximum:  # true for NaN, too
                self._set_current(allowed.maximum if current_a > allowed.maximum else allowed.minimum)
        except BaseException:
            with suppress(DeviceError):
                self.close()
            raise

    def __del__(self) -> None:
        """Leave no light on that nobody holds any more."""
        with suppress(Exception):  # there is nobody left to tell
            self.close()

    def properties(self) -> dict[str, Property]:
        """All settings in force; a driver adds what else its light can tell."""
        allowed = self.current_range_a
        return {
            "name": self.name,
            "is_on": self.is_on,
            "current_a": self.current_a,
            "lowest_current_a": allowed.minimum,
            "highest_current_a": allowed.maximum,
            "lit_s": self.lit_s,
        }

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
            if not self._is_lit():
                return self._set_current(current_a)
            before_a = self._read_current()
            try:
                return self._ramp(current_a, allowed)
            except _REFUSALS:
                self._set_current(before_a)
                raise

    @property
    def is_on(self) -> bool:
        """Whether the light is lit."""
        with self._guarded():
            is_lit = self._is_lit()
            if is_lit != (self._lit_since_s is not None):  # it went out by itself
                self._note(on=is_lit)
            return is_lit

    def set_on(self, on: bool) -> None:
        """Switch the light; the current comes up in steps."""
        with self._guarded():
            if on and not self._is_lit():
                self._light_up()
            else:
                self._switch(on=on)
                self._note(on=on)

    @property
    def lit_s(self) -> float:
        """How long the light has been on since it was opened, in all."""
        now_s = 0.0 if self._lit_since_s is None else time.monotonic() - self._lit_since_s
        return self._lit_before_s + now_s

    def close(self) -> None:
        """Switch off and let go; closing twice is allowed. A thread that talks to it is waited for, but not long."""
        _open_lights.discard(self)
        has_turn = self._turn.acquire(timeout=_LAST_WAIT_S)
        try:
            self._switch_off_and_let_go()
        finally:
            if has_turn:
                self._turn.release()

    def _switch_off_and_let_go(self) -> None:
        if self._is_closed:
            return
        was_lit = self._lit_since_s is not None
        self._note(on=False)
        try:
            if self._has_begun and not self._loss:
                self._switch(on=False)
        except DeviceError as error:
            if was_lit:  # and nobody has been told
                raise _still_lit(error) from error
            if not isinstance(error, Disconnected):
                raise
        finally:
            super().close()

    def _range(self) -> Range:
        head = self._read_range()
        if self._limit_a is None:
            return head
        if not self._limit_a >= head.minimum:
            raise BadValue(f"the limit of {self._limit_a:g} A is below the lowest current, {head.minimum:g} A")
        return Range(head.minimum, min(head.maximum, self._limit_a))

    def _light_up(self) -> None:
        """Switch on at the lowest current and go up to the one that was set."""
        wanted_a, allowed = self._read_current(), self._range()
        try:
            self._set_current(allowed.minimum)
            self._note(on=True)
            self._switch(on=True)
            self._ramp(min(wanted_a, allowed.maximum), allowed)
        except _REFUSALS:
            self._switch(on=False)
            self._note(on=False)
            self._set_current(wanted_a)
            raise

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
        """Speak to the light; after a fault, whichever it is, Ctrl-C among them, it is switched off."""
        with self._talking():
            try:
                yield
            except _REFUSALS:
                raise
            except BaseException as error:
                was_lit = self._lit_since_s is not None
                self._note(on=False)
                try:
                    self._switch(on=False)
                except Exception as second:
                    if was_lit and isinstance(error, DeviceError):
                        raise _still_lit(error) from second
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


def _still_lit(error: DeviceError) -> DeviceError:
    """The same error of a light that could not be switched off either."""
    return type(error)(f"{error}; the light may still be on: switch it off by hand")


_open_lights: WeakSet[LightSource] = WeakSet()


@atexit.register
def _switch_all_off() -> None:
    """Leave no light on when the interpreter ends, however that comes, or say so."""
    for light in tuple(_open_lights):
        try:
            light.close()
        except DeviceError as error:
            sys.stderr.write(f"{error}\n")
        except Exception:  # noqa: BLE001, S112 - the next one's turn; there is nobody left to tell
            continue


def _leave_all_to_the_parent() -> None:
    """Close nothing in a process that was forked off: the lights and their wires are its parent's."""
    for light in tuple(_open_lights):
        light._is_closed = True  # noqa: SLF001 - nobody else may
    _open_lights.clear()


if hasattr(os, "register_at_fork"):  # not on Windows
    os.register_at_fork(after_in_child=_leave_all_to_the_parent)
