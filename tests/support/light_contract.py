"""Contract tests for every light, simulated or real over its stand-in.

Subclass and supply the fixtures: `light`, open and off; `reopen`, which opens the same one again; and `faults` for the
fault contract. `drivers/contract/` holds the checks of lights.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import pytest

from drivers.contract import light as light_contract
from drivers.contract.light import LIGHT_CHECKS
from drivers.interface import DeviceError, Disconnected, LightSource
from support.camera_contract import AT_ONCE_S, after_pause, expect_within, repeat
from support.light_log import LightLog
from support.patience import own_time

BY_HAND = "the light may still be on: switch it off by hand"


class LightFaults(Protocol):
    """Faults of a light."""

    @property
    def log(self) -> LightLog:
        """Log of the light, independent of the driver."""

    def unplug(self) -> None:
        """Pull the plug."""

    def plug_in(self) -> None:
        """Put the plug back, so that the light can be reopened."""

    def refuse_next(self) -> None:
        """Refuse the next setting."""

    def fail_next(self) -> None:
        """Fail the next exchange only: garbage, or no answer in time."""


class LightContract:
    @pytest.mark.parametrize("check", LIGHT_CHECKS, ids=lambda check: check.__name__)
    def test_light_keeps_the_contract(self, light: LightSource, check: Callable[[LightSource], None]) -> None:
        check(light)
        assert not light.is_on

    def test_closes_and_refuses_further_calls(self, light: LightSource) -> None:
        light_contract.check_closes(light)

    def test_reopens_after_close(self, light: LightSource, reopen: Callable[[], LightSource]) -> None:
        light_contract.check_reopens(light, reopen)


class LightFaultContract(LightContract):
    def test_shines_only_while_on(self, light: LightSource, faults: LightFaults) -> None:
        light.set_current(light.current_range_a.maximum)
        assert faults.log.lightings == 0
        light.set_on(True)
        assert faults.log.is_lit
        light.set_on(False)
        assert not faults.log.is_lit
        light.set_on(True)
        light.close()
        assert not faults.log.is_lit
        assert faults.log.lightings == 2

    def test_fault_switches_off(self, light: LightSource, faults: LightFaults) -> None:
        light.set_on(True)
        faults.fail_next()
        with pytest.raises(DeviceError):
            _ = light.current_a
        assert not light.is_on
        assert faults.log.lightings == 1  # no flash on the way off
        assert not faults.log.is_lit
        light.set_on(True)
        assert faults.log.is_lit

    def test_unplugged_every_call_raises_and_it_closes(self, light: LightSource, faults: LightFaults) -> None:
        light.set_on(True)
        faults.unplug()
        expect_within(Disconnected, lambda: light.set_on(True))
        for what, call in light_contract.calls_of(light).items():
            with pytest.raises(Disconnected):
                pytest.fail(f"{what} returned {call()}")
        assert light.name
        light.close()
        light.close()

    @pytest.mark.parametrize("question", ["is_on", "current_a"])
    def test_unplugged_while_lit_asks_for_a_hand(self, light: LightSource, faults: LightFaults, question: str) -> None:
        light.set_on(True)
        faults.unplug()
        with pytest.raises(Disconnected, match=BY_HAND):
            getattr(light, question)
        with pytest.raises(Disconnected, match=BY_HAND):
            light.set_on(False)
        light.close()

    def test_unplugged_while_lit_close_asks_for_a_hand(self, light: LightSource, faults: LightFaults) -> None:
        light.set_on(True)
        faults.unplug()
        with pytest.raises(Disconnected, match=BY_HAND):
            light.close()
        light.close()

    def test_unplugged_while_dark_asks_for_no_hand(self, light: LightSource, faults: LightFaults) -> None:
        faults.unplug()
        with pytest.raises(Disconnected) as lost:
            _ = light.is_on
        assert BY_HAND not in str(lost.value)
        light.close()

    def test_unplugged_during_command_raises_at_once(self, light: LightSource, faults: LightFaults) -> None:
        light.set_on(True)
        allowed = light.current_range_a
        with own_time() as elapsed_s:
            pulled_s = after_pause(faults.unplug, elapsed_s)
            with pytest.raises(Disconnected):
                repeat(lambda: (light.set_current(allowed.minimum), light.set_current(allowed.maximum)))
            assert elapsed_s() - pulled_s() < AT_ONCE_S
        light.close()

    def test_plugged_in_again_reopens_dark(
        self, light: LightSource, reopen: Callable[[], LightSource], faults: LightFaults
    ) -> None:
        light.set_on(True)
        faults.unplug()
        expect_within(Disconnected, lambda: light.is_on)
        faults.plug_in()
        with pytest.raises(Disconnected):  # it may have forgotten its settings
            _ = light.is_on
        light.close()
        with reopen() as again:
            assert not again.is_on
            assert faults.log.lightings == 1
            assert not faults.log.is_lit
            again.set_on(True)
            assert faults.log.is_lit

    def test_refused_current_changes_nothing(self, light: LightSource, faults: LightFaults) -> None:
        allowed = light.current_range_a
        before_a = light.set_current(allowed.minimum + (allowed.maximum - allowed.minimum) / 2)
        faults.refuse_next()
        with pytest.raises(DeviceError) as refused:
            light.set_current(allowed.maximum)
        assert not isinstance(refused.value, Disconnected)
        assert light.current_a == before_a
        assert faults.log.lightings == 0

    def test_refused_current_leaves_lit_light_on(self, light: LightSource, faults: LightFaults) -> None:
        allowed = light.current_range_a
        before_a = light.set_current(allowed.minimum + (allowed.maximum - allowed.minimum) / 2)
        light.set_on(True)
        faults.refuse_next()
        with pytest.raises(DeviceError):
            light.set_current(allowed.minimum)
        assert light.is_on
        assert faults.log.is_lit
        assert faults.log.lightings == 1
        assert light.current_a == before_a
