"""What every light must do."""

from __future__ import annotations

from collections.abc import Callable

from drivers.contract.device import Calls, check_properties, require, require_all_raise, require_raises
from drivers.errors import BadValue, WrongState
from drivers.light_source import LightSource

_NAN = float("nan")


def check_tells_what_it_is(light: LightSource) -> None:
    """It is off, says what it is, and the current that is set is allowed."""
    require(not light.is_on, "it is on before it was switched on")
    check_properties(light)
    light.current_range_a.check(light.current_a, "current_a")


def check_switches(light: LightSource) -> None:
    """It can be switched on and off, each also twice, and comes back with the current that was set."""
    current_a = light.set_current(_middle_a(light))
    for on in (True, True, False, False, True, False):
        light.set_on(on)
        require(light.is_on is on, f"it was switched {'on' if on else 'off'} and is not")
        require(light.current_a == current_a, f"switching moved the current from {current_a} A to {light.current_a} A")


def check_counts_its_time(light: LightSource) -> None:
    """It counts the time for which it is lit, and no other."""
    before_s = light.lit_s
    require(light.lit_s == before_s, "the time runs while it is off")
    light.set_on(True)
    light.set_on(False)
    lit_s = light.lit_s
    require(lit_s > before_s, "the time does not run while it is on")
    require(light.lit_s == lit_s, "the time goes on while it is off")


def check_currents(light: LightSource) -> None:
    """It takes the currents that it allows, rounds them stably, and refuses all others; so also while it is lit."""
    allowed = light.current_range_a
    width_a = allowed.maximum - allowed.minimum
    for on in (False, True):
        light.set_on(on)
        for current_a in (allowed.maximum, allowed.minimum, _middle_a(light)):
            taken_a = light.set_current(current_a)
            require(light.current_a == taken_a, f"{taken_a} A was said to be in force, {light.current_a} A is")
            require(allowed.minimum <= taken_a <= allowed.maximum, f"{current_a} A became {taken_a} A")
            require(abs(taken_a - current_a) <= width_a / 4, f"{current_a} A became {taken_a} A")
            require(light.set_current(taken_a) == taken_a, f"{taken_a} A, once given, is not taken again")
        for current_a in (_NAN, allowed.minimum - 0.1, allowed.maximum + 0.1, float("inf")):
            require_raises(BadValue, f"{current_a} A", light.set_current, current_a)
        require(light.current_a == taken_a, "a refused current did not leave the one before")
        require(light.is_on is on, "setting the current switched it")
    light.set_on(False)


def check_closes_for_good(light: LightSource) -> None:
    """It closes while it is lit, twice, and answers nothing afterwards but that it is closed."""
    light.set_on(True)
    light.close()
    light.close()
    require_all_raise(WrongState, calls_of(light))


def check_opens_anew(light: LightSource, reopen: Callable[[], LightSource]) -> None:
    """It can be opened again after it was closed while lit, and is off then."""
    light.set_on(True)
    light.close()
    with reopen() as again:
        require(not again.is_on, "opened anew, it is on")
        again.set_on(True)
        require(again.is_on, "opened anew, it cannot be switched on")


def calls_of(light: LightSource) -> Calls:
    """Every question and command there is."""
    return {
        "current_range_a": lambda: light.current_range_a,
        "current_a": lambda: light.current_a,
        "set_current": lambda: light.set_current(0.0),
        "is_on": lambda: light.is_on,
        "set_on": lambda: light.set_on(True),
        "properties": light.properties,
    }


LIGHT_CHECKS: tuple[Callable[[LightSource], None], ...] = (
    check_tells_what_it_is,
    check_switches,
    check_counts_its_time,
    check_currents,
)


def _middle_a(light: LightSource) -> float:
    allowed = light.current_range_a
    return (allowed.minimum + allowed.maximum) / 2
