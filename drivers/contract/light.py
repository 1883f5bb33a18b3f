"""Contract of all lights."""

from collections.abc import Callable

from drivers.contract import Calls, calls, check_properties, require, require_all_raise, require_raises
from drivers.errors import BadValue, WrongState
from drivers.light_source import LightSource

_NAN = float("nan")


def check_identity(light: LightSource) -> None:
    """It is off; its properties and its current are valid."""
    require(not light.is_on, "it is on after opening")
    check_properties(light)
    light.current_range_a.check(light.current_a, "current_a")


def check_switches(light: LightSource) -> None:
    """It switches on and off, each also twice, keeps its current, and refuses what is neither True nor False."""
    current_a = light.set_current(_middle_a(light))
    for on in (True, True, False, False, True, False):
        light.set_on(on)
        require(light.is_on is on, f"it does not switch {'on' if on else 'off'}")
        require(
            light.current_a == current_a, f"switching changed the current from {current_a} A to {light.current_a} A"
        )
    for word in ("off", 1, None):
        require_raises(BadValue, f"the switch {word!r}", light.set_on, word)
    require(not light.is_on, "a refused switch put it on")


def check_currents(light: LightSource) -> None:
    """It accepts all allowed currents, rounds them stably, and refuses others, also while lit."""
    allowed = light.current_range_a
    width_a = allowed.maximum - allowed.minimum
    for on in (False, True):
        light.set_on(on)
        for current_a in (allowed.maximum, allowed.minimum, _middle_a(light)):
            taken_a = light.set_current(current_a)
            require(light.current_a == taken_a, f"{light.current_a} A is in force, not {taken_a} A as it returned")
            require(allowed.minimum <= taken_a <= allowed.maximum, f"{current_a} A became {taken_a} A")
            require(abs(taken_a - current_a) <= width_a / 4, f"{current_a} A became {taken_a} A")
            require(light.set_current(taken_a) == taken_a, f"{taken_a} A, once in force, is not accepted again")
        for current_a in (_NAN, allowed.minimum - 0.1, allowed.maximum + 0.1, float("inf")):
            require_raises(BadValue, f"{current_a} A", light.set_current, current_a)
        require(light.current_a == taken_a, "a refused current changed the one in force")
        require(light.is_on is on, "setting the current switched it")
    light.set_on(False)


def check_closes(light: LightSource) -> None:
    """It closes while lit, and twice; every later call raises."""
    light.set_on(True)
    light.close()
    light.close()
    require_all_raise(WrongState, calls_of(light))


def check_reopens(light: LightSource, reopen: Callable[[], LightSource]) -> None:
    """It reopens after it was closed while lit, and is off then."""
    light.set_on(True)
    light.close()
    with reopen() as again:
        require(not again.is_on, "reopened, it is on")
        again.set_on(True)
        require(again.is_on, "reopened, it does not switch on")


def calls_of(light: LightSource) -> Calls:
    """Every query and command."""
    commands = {"set_current": (0.0,), "set_on": (True,), "properties": ()}
    return calls(light, ("current_range_a", "current_a", "is_on"), commands)


LIGHT_CHECKS: tuple[Callable[[LightSource], None], ...] = (check_identity, check_switches, check_currents)


def _middle_a(light: LightSource) -> float:
    allowed = light.current_range_a
    return (allowed.minimum + allowed.maximum) / 2
