"""The light interface, and the safety rules common to all lights.

A light is off after opening, after closing, after any fault and at interpreter exit. Its current rises in steps, never
above the limits of its head and of its owner. A driver implements the methods with a leading underscore.
"""

import atexit
import os
import sys
import threading
import time
from abc import abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Literal
from weakref import WeakSet

import numpy as np
from typing_extensions import Doc

from drivers.device import Device, Property, Range, switched
from drivers.errors import REFUSALS, BadValue, DeviceError, Disconnected, LightHeldOff, WrongState

KEPT_CURRENT = Doc("Current at the start; omitted: as the device has it")  # help of settings that lights share
OWNERS_LIMIT = Doc("Highest current allowed, below the limit of the head")
MAY_BE_ON = "the light may still be on: switch it off by hand"  # in the error of a light that does not answer
_RAMP_STEPS = 8  # from the lowest to the highest current
_RAMP_S = 0.08
_ATTEMPTS = 2  # to switch off: a command can be lost
_LOCK_TIMEOUT_S = 1.0  # for another thread, which may hang, before the light is closed


class OffCount:
    """Counts how often a light was switched off by a person, or went off on its own.

    A command may light it only if the count is still that of the time when the command was made. One thread begins
    commands; any thread may add.
    """

    def __init__(self) -> None:
        self.now = 0
        self._at_command: int | None = None  # None without commands: each call is made now
        self._adding = threading.Lock()

    def add(self) -> None:
        """Count one more."""
        with self._adding:
            self.now += 1

    def begin_command(self, made_at: int) -> None:
        """Begin a command that was made at this count."""
        self._at_command = made_at

    @property
    def may_light(self) -> bool:
        """True if the light has not gone off since the present command was made."""
        return self._at_command in (None, self.now)


class LightSource(Device):
    """A light with an adjustable current.

    A driver's constructor connects and calls `_begin` last, which closes the connection if it fails.
    """

    def __init__(self, *, limit_a: float | None = None, sleep: Callable[[float], None] = time.sleep) -> None:
        """`limit_a` is the owner's limit of the current; `sleep` waits between two steps of a ramp."""
        super().__init__("light")
        self._limit_a, self._sleep = limit_a, sleep
        self.off_count = OffCount()  # compared before the light is lit, and while its current rises
        self.off_reason = ""  # why it went off on its own, until it is lit again
        self._has_begun = False  # until then the device is unknown, and `close` sends nothing to it
        self._is_noted_lit = False  # as far as known without a query

    def _begin(self) -> None:
        """Identify the device, switch it off, and bring its current into the allowed range."""
        try:
            self._identify()
        except BaseException:
            self._close()
            raise
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
        """Leave no unreferenced light on."""
        with suppress(Exception):  # no caller to raise to
            self.close()

    def properties(self) -> dict[str, Property]:
        """All settings in force; drivers add what else their light reports."""
        allowed = self.current_range_a
        return {
            "name": self.name,
            "is_on": self.is_on,
            "current_a": self.current_a,
            "lowest_current_a": allowed.minimum,
            "highest_current_a": allowed.maximum,
        }

    @property
    def current_range_a(self) -> Range:
        """Currents that driver, head and owner allow."""
        with self._guarded():
            return self._range()

    @property
    def current_a(self) -> float:
        """Current in force, which flows while the light is on."""
        with self._guarded():
            return self._read_current()

    def set_current(self, current_a: float) -> float:
        """Change the current, upwards in steps while the light is on; return the one in force."""
        with self._guarded():
            allowed = self._range()
            allowed.check(current_a, "current_a")
            if not self._is_lit():
                return self._set_current(current_a)
            before_a = self._read_current()
            try:
                return self._ramp(current_a, allowed)
            except REFUSALS:
                self._set_current(before_a)
                raise

    @property
    def is_on(self) -> bool:
        """True while the light is lit."""
        with self._guarded():
            self._is_noted_lit = self._is_lit()  # it may have gone out on its own
            return self._is_noted_lit

    def set_on(self, on: bool) -> None:
        """Switch the light; its current rises in steps.

        Any thread may switch it off; that waits for one call of the other thread at most. `LightHeldOff` if it has gone
        off since the present command was made: see `OffCount`.
        """
        on = switched(on)
        with self._guarded():
            if on and not self._is_lit():
                self._check_may_light()
                self._light_up()
            else:
                self._switch(on=on)
                self._is_noted_lit = on

    @property
    def is_silent(self) -> bool:
        """True if a call has waited for some seconds, as far as known without another one; any thread may ask."""
        return False

    def keep_alive(self, within_s: float) -> None:
        """Promise another call within this time, from any thread; a light that is guarded goes off without it."""

    def note_light(self, on: bool) -> None:
        """Switch the light, or without control record that a person has switched it."""
        self.set_on(on)

    def close(self) -> None:
        """Switch off and release, after waiting briefly for another thread's call; closing twice is allowed."""
        _open_lights.discard(self)
        has_lock = self._lock.acquire(timeout=_LOCK_TIMEOUT_S)
        try:
            self._switch_off_and_release()
        finally:
            if has_lock:
                self._lock.release()

    @property
    def _may_shine(self) -> bool:
        """True if a light that this object cannot switch off may be on."""
        return True

    def _switch_off_and_release(self) -> None:
        if self._is_closed:
            return
        was_lit = self._is_noted_lit
        self._is_noted_lit = False
        try:
            if self._has_begun and not self._loss:
                self._switch(on=False)
        except DeviceError as error:
            if was_lit and self._may_shine:
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
        """Switch on at the lowest current and ramp up to the set one."""
        wanted_a, allowed = self._read_current(), self._range()
        try:
            self._set_current(allowed.minimum)
            self._is_noted_lit = True
            self._switch(on=True)
            self.off_reason = ""
            self._ramp(min(wanted_a, allowed.maximum), allowed)
        except REFUSALS:
            self._switch(on=False)
            self._is_noted_lit = False
            self._set_current(wanted_a)
            raise

    def _ramp(self, current_a: float, allowed: Range) -> float:
        start_a = self._read_current()
        steps = int(np.ceil(_RAMP_STEPS * (current_a - start_a) / max(allowed.maximum - allowed.minimum, 1e-12)))
        for step_a in np.linspace(start_a, current_a, max(steps, 1) + 1)[1:-1]:
            self._check_may_light()
            self._set_current(float(step_a))
            self._sleep(_RAMP_S / _RAMP_STEPS)
        return self._set_current(current_a)

    def _note_went_off(self, reason: str) -> None:
        """Note that the light went off on its own."""
        self._is_noted_lit, self.off_reason = False, reason
        self.off_count.add()

    def _check_may_light(self) -> None:
        if not self.off_count.may_light:
            reason = self.off_reason or "the light was switched off meanwhile"
            raise LightHeldOff(f"{reason}: switch it on (L) and repeat")

    @contextmanager
    def _guarded(self) -> Iterator[None]:
        """Access the light; switch it off after any fault or Ctrl-C."""
        with self._access():
            try:
                yield
            except REFUSALS:
                raise
            except BaseException as error:
                was_lit = self._is_noted_lit
                self._is_noted_lit = False
                try:
                    self._switch(on=False)
                except Exception as second:
                    if was_lit and self._may_shine and isinstance(error, DeviceError):
                        raise _still_lit(error) from second
                raise

    def _identify(self) -> None:
        """Check which device answers; nothing else is sent to an unknown one."""

    @abstractmethod
    def _read_range(self) -> Range: ...

    @abstractmethod
    def _read_current(self) -> float: ...

    @abstractmethod
    def _set_current(self, current_a: float) -> float: ...

    @abstractmethod
    def _is_lit(self) -> bool: ...

    @abstractmethod
    def _switch(self, *, on: bool) -> None: ...


class LedDriver(LightSource):
    """A light that reports refusals, and may be switched off by hand or go out on its own."""

    _where: str  # the light, in errors
    _panel: str  # where a person can switch it off
    _switching: tuple[str, str]  # commands: off, on
    _is_wanted_lit = False

    def _is_lit(self) -> bool:
        self._check_lit()
        return self._is_output_on()

    def _switch(self, *, on: bool) -> None:
        self._is_wanted_lit = False
        if on:
            refusal = self._send(self._switching[True])
            self._is_wanted_lit = True
            self._check_lit(refusal)
            return
        for _ in range(_ATTEMPTS):
            self._send(self._switching[False])
            if not self._is_output_on():
                return
        raise DeviceError(f"{self._where} is still on after the command to switch off; unplug its head")

    def _check_lit(self, refusal: str = "") -> None:
        """Raise if the light should be on but is off."""
        if self._is_wanted_lit:
            if fault := self._fault():
                raise DeviceError(f"{self._where}{fault}")
            if not self._is_output_on():
                reason = refusal or f"switched off at its {self._panel}, or on its own"
                raise DeviceError(f"{self._where} is off: {reason}")

    def _execute(self, command: str) -> None:
        """Send a command; raise `BadValue` if it was refused."""
        if refusal := self._send(command):
            raise BadValue(f"{self._where} refuses “{command}”: {refusal}")

    @abstractmethod
    def _send(self, command: str) -> str: ...  # returns why it was refused; empty if it was not

    @abstractmethod
    def _is_output_on(self) -> bool: ...

    @abstractmethod
    def _fault(self) -> str: ...  # why there is no light, to follow its name; empty if nothing is known


@dataclass(frozen=True, slots=True, kw_only=True)
class ManualLightSettings:
    """A light that a person switches."""

    driver: Literal["manual"] = "manual"


class ManualLight(LightSource):
    """Knows what a person has said; before that, and after closing, the light counts as on.

    It has no current: the only allowed one is 0. Closing sends nothing, as there is nothing to send it to.
    """

    def __init__(self, _settings: ManualLightSettings = ManualLightSettings()) -> None:
        super().__init__()
        self._name = "manual light"
        self._is_noted_on = True

    def note_light(self, on: bool) -> None:
        """Record that a person has switched the light."""
        with self._access():
            self._is_noted_on = self._is_noted_lit = switched(on)

    def set_on(self, on: bool) -> None:
        """Raise `WrongState` unless a person has noted that it is so."""
        with self._access():
            if switched(on) != self._is_noted_on:
                raise WrongState(f"the light is manual: switch it {'on' if on else 'off'} by hand, then confirm (L)")

    def _read_range(self) -> Range:
        return Range(0.0, 0.0)

    def _read_current(self) -> float:
        return 0.0

    def _set_current(self, current_a: float) -> float:
        return current_a

    def _is_lit(self) -> bool:
        return self._is_noted_on

    def _switch(self, *, on: bool) -> None:
        """Nothing to do: only a person can."""

    def _close(self) -> None:
        """Nothing to do."""


def _still_lit(error: DeviceError) -> DeviceError:
    """Extend the error of a light that could not be switched off."""
    return type(error)(f"{error}; {MAY_BE_ON}")


_open_lights: WeakSet[LightSource] = WeakSet()


@atexit.register
def _switch_all_off() -> None:
    """Leave no light on at interpreter exit, or say so."""
    for light in tuple(_open_lights):
        try:
            light.close()
        except DeviceError as error:
            sys.stderr.write(f"{error}\n")
        except Exception:  # noqa: BLE001, S112 - the other lights remain
            continue


def _forget_lights_of_parent() -> None:
    """Forget the lights in a forked process: they belong to the parent."""
    for light in tuple(_open_lights):
        light._is_closed = True  # noqa: SLF001 - same module
    _open_lights.clear()


if hasattr(os, "register_at_fork"):  # not on Windows
    os.register_at_fork(after_in_child=_forget_lights_of_parent)
