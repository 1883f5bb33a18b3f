"""Random commands and faults on a light: no hang, only `DeviceError`, no wrong answer, never lit by mistake."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import TypeVar

from hypothesis import strategies as st
from hypothesis.stateful import initialize, precondition, rule

from drivers.errors import REFUSALS, DeviceError, Disconnected
from drivers.interface import LightSource
from simulated_devices.clock import ManualClock
from support.storm import Storm

LONGEST_S = 4.0  # of one call
LOST_S = 2.0  # until a loss is noticed
T = TypeVar("T")


class LightStorm(Storm):
    """A subclass also supplies the true state of the light."""

    light: LightSource | None

    def open(self) -> LightSource:
        """Open the driver over `self.device`."""
        raise NotImplementedError

    def true_current_a(self) -> float:
        raise NotImplementedError

    def true_maximum_a(self) -> float:
        raise NotImplementedError

    def is_calm(self) -> bool:
        """No fault is pending and the device is plugged in."""
        return not self.device.faults and not self.device.is_unplugged

    def recover(self) -> None:
        """Plug in again and clear all faults."""
        self.device.faults.clear()
        self.device.refuses_next = False

    @initialize()
    def begin(self) -> None:
        self.clock, self.device = ManualClock(), self.make()
        self.light = self.open()

    def call(self, action: Callable[[LightSource], T]) -> T | None:
        """Return the result of the action, or None after a `DeviceError`, which must leave the light off."""
        assert self.light is not None
        start_s = self.clock.now()
        try:
            result = action(self.light)
        except Disconnected:
            assert self.clock.now() - start_s <= LOST_S
            return None
        except REFUSALS:
            return None
        except DeviceError:
            assert self.clock.now() - start_s <= LONGEST_S
            if self.is_calm():
                assert not self.device.is_lit
            return None
        assert self.clock.now() - start_s <= LONGEST_S
        return result

    @precondition(lambda self: self.light is not None)
    @rule(on=st.booleans())
    def switch(self, *, on: bool) -> None:
        def action(light: LightSource) -> bool:
            light.set_on(on)
            return True

        if self.call(action) and self.is_calm():
            assert self.device.is_lit is on

    @precondition(lambda self: self.light is not None)
    @rule(part=st.floats(0, 1) | st.just(2.0) | st.just(float("nan")))
    def set_current(self, part: float) -> None:
        current_a = part * self.true_maximum_a()
        taken_a = self.call(lambda light: light.set_current(current_a))
        assert taken_a is None or (taken_a == self.true_current_a() and taken_a <= current_a + 1e-9)

    @precondition(lambda self: self.light is not None)
    @rule()
    def read(self) -> None:
        current_a = self.call(lambda light: light.current_a)
        assert current_a in {None, self.true_current_a()}
        allowed = self.call(lambda light: light.current_range_a)
        assert allowed is None or allowed.maximum == self.true_maximum_a()
        is_on = self.call(lambda light: light.is_on)
        assert is_on in {None, self.device.is_lit}
        properties = self.call(lambda light: light.properties())
        assert properties is None or properties["name"]

    @rule(data=st.data())
    def fault(self, data: st.DataObject) -> None:
        if self.is_calm():  # one fault at a time
            self.happen(data.draw(self.faults()))

    @rule()
    def refuse(self) -> None:
        self.device.refuses_next = True

    @rule(duration_s=st.sampled_from([0.01, 0.3, 1.0]))
    def wait(self, duration_s: float) -> None:
        self.clock.sleep(duration_s)

    @precondition(lambda self: self.light is not None)
    @rule()
    def close(self) -> None:
        assert self.light is not None
        was_calm = self.is_calm()
        with suppress(DeviceError):  # a late answer
            self.light.close()
        self.light.close()
        assert not (was_calm and self.device.is_lit)
        self.light = None

    @precondition(lambda self: self.light is None)
    @rule(is_repaired=st.booleans())
    def reopen(self, *, is_repaired: bool) -> None:
        if is_repaired:
            self.recover()
        try:
            self.light = self.open()
        except DeviceError:
            assert not is_repaired
        else:
            assert not self.device.is_lit

    def teardown(self) -> None:
        super().teardown()
        if getattr(self, "light", None) is not None:
            self.recover()
            assert self.light is not None
            with suppress(DeviceError):
                self.light.close()


class HeatStorm(LightStorm):
    """Storm of a light that switches off when it is too hot."""

    def recover(self) -> None:
        super().recover()
        self.device.is_hot = False

    @rule(is_hot=st.booleans())
    def change_temperature(self, *, is_hot: bool) -> None:
        if is_hot:
            self.device.heat_up()
        else:
            self.device.is_hot = False
