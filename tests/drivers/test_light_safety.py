"""What keeps a light safe, whichever it is: proven on a bulb that does what it is told, and remembers it."""

from __future__ import annotations

import gc
import subprocess
import sys
import textwrap
import threading
import time
import weakref
from pathlib import Path
from typing import Any

import pytest
from support.paths import TESTS
from support.patience import HANG_S

from drivers.interface import BadValue, DeviceError, DeviceTimeout, Disconnected, LightSource, Range, WrongState


class Bulb:
    """What is at the other end of the wire."""

    def __init__(self, current_a: float = 0.3, *, is_lit: bool = False, lowest_a: float = 0.0) -> None:
        self.current_a, self.is_lit, self.lowest_a = current_a, is_lit, lowest_a
        self.lit_with_a: list[float] = []  # every current that flowed, in order
        self.trouble: dict[str, BaseException] = {}  # by what is asked for
        self.is_closed = False

    def note(self) -> None:
        if self.is_lit:
            self.lit_with_a.append(self.current_a)

    def meet(self, what: str) -> None:
        if what in self.trouble:
            raise self.trouble[what]


class BulbLight(LightSource):
    name = "bulb"

    def __init__(self, bulb: Bulb, **options: Any) -> None:
        super().__init__(sleep=lambda _: None, **options)
        self.bulb = bulb
        self._begin()

    def _read_range(self) -> Range:
        self.bulb.meet("range")
        return Range(self.bulb.lowest_a, 1.0)

    def _read_current(self) -> float:
        self.bulb.meet("current")
        return self.bulb.current_a

    def _set_current(self, current_a: float) -> float:
        self.bulb.meet(f"{current_a:.3f}")
        self.bulb.current_a = current_a
        self.bulb.note()
        return current_a

    def _is_lit(self) -> bool:
        return self.bulb.is_lit

    def _switch(self, *, on: bool) -> None:
        self.bulb.meet("on" if on else "off")
        self.bulb.is_lit = on
        self.bulb.note()

    def _close(self) -> None:
        self.bulb.is_closed = True


def test_opening_switches_off_and_brings_the_current_under_the_limit() -> None:
    bulb = Bulb(0.9, is_lit=True)
    light = BulbLight(bulb, limit_a=0.4)
    assert not bulb.is_lit
    assert light.current_a == 0.4
    assert light.current_range_a == Range(0.0, 0.4)
    light.set_on(True)
    with pytest.raises(BadValue, match=r"0\.5 is outside 0 \.\.\. 0\.4"):
        light.set_current(0.5)
    assert max(bulb.lit_with_a) == 0.4


@pytest.mark.parametrize("current_a", [float("nan"), 2.0, 0.0])
def test_a_current_that_cannot_be_is_replaced_at_opening(current_a: float) -> None:
    with BulbLight(Bulb(current_a, lowest_a=0.1)) as light:
        light.current_range_a.check(light.current_a, "current_a")


def test_the_owners_limit_never_raises_the_heads() -> None:
    assert BulbLight(Bulb(), limit_a=5.0).current_range_a.maximum == 1.0


def test_after_a_fault_its_time_does_not_run() -> None:
    bulb = Bulb()
    light = BulbLight(bulb)
    light.set_on(True)
    bulb.trouble["current"] = DeviceTimeout("no answer")
    with pytest.raises(DeviceTimeout):
        _ = light.current_a
    lit_s = light.lit_s
    time.sleep(0.01)
    assert light.lit_s == lit_s > 0


@pytest.mark.parametrize("limit_a", [0.05, float("nan")])
def test_a_limit_below_the_lowest_current_cannot_be_opened(limit_a: float) -> None:
    bulb = Bulb(lowest_a=0.1)
    with pytest.raises(BadValue, match="below the lowest current"):
        BulbLight(bulb, limit_a=limit_a)
    assert bulb.is_closed


def test_the_current_comes_up_in_steps_and_goes_down_at_once() -> None:
    bulb = Bulb(0.8)
    light = BulbLight(bulb)
    light.set_on(True)
    assert len(bulb.lit_with_a) > 4
    assert bulb.lit_with_a == sorted(bulb.lit_with_a)
    assert max(b - a for a, b in zip(bulb.lit_with_a, bulb.lit_with_a[1:], strict=False)) <= 0.126
    assert bulb.lit_with_a[0] == 0.0
    assert bulb.lit_with_a[-1] == light.current_a == 0.8
    bulb.lit_with_a.clear()
    light.set_current(0.1)
    assert bulb.lit_with_a == [0.1]
    light.set_current(1.0)
    assert len(bulb.lit_with_a) == 1 + 8


@pytest.mark.parametrize(
    "fault", [DeviceTimeout("no answer"), DeviceError("garbage"), OSError(5, "a bug"), KeyboardInterrupt()]
)
def test_any_fault_switches_it_off(fault: BaseException) -> None:
    bulb = Bulb()
    light = BulbLight(bulb)
    light.set_on(True)
    bulb.trouble["current"] = fault
    with pytest.raises(type(fault)):
        _ = light.current_a
    assert not bulb.is_lit
    bulb.trouble.clear()
    assert not light.is_on
    lit_s = light.lit_s
    assert lit_s > 0
    assert light.lit_s == lit_s


def test_a_fault_while_it_comes_up_switches_it_off() -> None:
    bulb = Bulb(0.8)
    light = BulbLight(bulb)
    bulb.trouble["0.343"] = DeviceTimeout("no answer")  # the third of seven steps
    with pytest.raises(DeviceTimeout):
        light.set_on(True)
    assert bulb.lit_with_a
    assert not bulb.is_lit


def test_a_refusal_while_it_comes_up_leaves_it_off_with_its_current() -> None:
    bulb = Bulb(0.8)
    light = BulbLight(bulb)
    bulb.trouble["0.343"] = BadValue("not that one")
    with pytest.raises(BadValue):
        light.set_on(True)
    assert (bulb.is_lit, light.is_on, light.current_a, light._lit_since_s) == (False, False, 0.8, None)


def test_a_refused_step_leaves_the_current_before_and_the_light_on() -> None:
    bulb = Bulb(0.2)
    light = BulbLight(bulb)
    light.set_on(True)
    bulb.trouble["0.800"] = BadValue("too much")
    with pytest.raises(BadValue):
        light.set_current(0.8)
    assert (bulb.is_lit, light.current_a) == (True, 0.2)


@pytest.mark.parametrize("kind", [DeviceTimeout, Disconnected])
def test_a_lit_light_that_cannot_be_switched_off_is_told(kind: type[DeviceError]) -> None:
    bulb = Bulb()
    light = BulbLight(bulb)
    light.set_on(True)
    bulb.trouble = {"current": kind("it is silent"), "off": kind("it is silent")}
    with pytest.raises(kind, match=r"^it is silent; the light may still be on: switch it off by hand$"):
        _ = light.current_a
    bulb.trouble.clear()


@pytest.mark.parametrize("kind", [DeviceTimeout, Disconnected])
def test_closing_tells_when_it_could_not_switch_off_and_closes_all_the_same(kind: type[DeviceError]) -> None:
    bulb = Bulb()
    light = BulbLight(bulb)
    light.set_on(True)
    bulb.trouble["off"] = kind("it is silent")
    with pytest.raises(kind, match="may still be on: switch it off by hand"):
        light.close()
    assert bulb.is_closed
    light.close()
    with pytest.raises(WrongState):
        light.set_on(True)


def test_a_light_that_fails_at_opening_is_let_go() -> None:
    bulb = Bulb()
    bulb.trouble["off"] = DeviceTimeout("it is silent")
    with pytest.raises(DeviceTimeout):
        BulbLight(bulb)
    assert bulb.is_closed


def test_the_timer_stops_when_it_goes_out_by_itself() -> None:
    bulb = Bulb()
    light = BulbLight(bulb)
    light.set_on(True)
    bulb.is_lit = False  # too hot
    assert not light.is_on
    lit_s = light.lit_s
    assert light.lit_s == lit_s


def test_a_light_that_nobody_holds_any_more_goes_out() -> None:
    bulb = Bulb()
    light = BulbLight(bulb)
    light.set_on(True)
    gone = weakref.ref(light)
    del light
    gc.collect()
    assert gone() is None
    assert (bulb.is_lit, bulb.is_closed) == (False, True)


def test_one_that_was_never_opened_says_nothing_to_what_hangs_there() -> None:
    class Stranger(BulbLight):
        def _begin(self) -> None:
            raise WrongState("this is another instrument")

    bulb = Bulb(is_lit=True)
    with pytest.raises(WrongState):
        Stranger(bulb)
    gc.collect()
    assert bulb.is_lit


PROGRAM = """
    import os, signal, sys, threading, time
    signal.signal(signal.SIGINT, signal.default_int_handler)  # whatever the tests were started with
    sys.path[:0] = {tests!r}
    from test_light_safety import Bulb, BulbLight

    class Loud(Bulb):
        def note(self):
            print("lit" if self.is_lit else "dark", flush=True)

    light = BulbLight(Loud())
    light.set_on(True)
"""
ENDS = {
    "the end": ("", 0),
    "an error": ("raise ZeroDivisionError", 1),
    "sys.exit": ("sys.exit(3)", 3),
    "Ctrl-C": ("os.kill(os.getpid(), signal.SIGINT); time.sleep(10)", -2),
    "a thread that hangs in it": (
        (
            "light._sleep = lambda _: time.sleep(60); hang = lambda: light.set_current(1.0);"
            " threading.Thread(target=hang, daemon=True).start(); time.sleep(0.2)"
        ),
        0,
    ),
}


@pytest.mark.parametrize("ending", ENDS, ids=ENDS)
def test_it_goes_out_when_the_interpreter_ends(ending: str) -> None:
    code, status = ENDS[ending]
    program = textwrap.dedent(PROGRAM.format(tests=[str(TESTS), str(Path(__file__).parent)]) + "    " + code + "\n")
    ended = subprocess.run(  # noqa: S603 - this interpreter
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=HANG_S, check=False
    )
    said = ended.stdout.split()
    assert "lit" in said
    assert said[-1] == "dark", ended.stderr
    assert ended.returncode == status


def test_a_process_that_was_forked_off_leaves_it_on() -> None:
    code = "if not os.fork(): sys.exit(light.close())\n    os.wait(); print('then', flush=True)"
    program = textwrap.dedent(PROGRAM.format(tests=[str(TESTS), str(Path(__file__).parent)]) + "    " + code + "\n")
    ended = subprocess.run(  # noqa: S603 - this interpreter
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=HANG_S, check=True
    )
    said = ended.stdout.split()
    assert said[said.index("then") - 1] == "lit"
    assert said[-1] == "dark"


@pytest.mark.parametrize("close", ["at the interpreter's exit", "by a call"])
def test_closing_from_another_thread_waits_for_its_turn(close: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A command under way is finished first, and none can follow."""
    monkeypatch.setattr("drivers.light_source._LOCK_TIMEOUT_S", HANG_S)
    bulb = Bulb(0.8)
    light = BulbLight(bulb)
    entered = threading.Event()

    def slowly(_: float) -> None:
        entered.set()
        time.sleep(0.02)

    light._sleep = slowly
    worker = threading.Thread(target=lambda: light.set_on(True))
    worker.start()
    entered.wait(HANG_S)
    from drivers.light_source import _switch_all_off  # noqa: PLC0415 - it is not for others

    light.close() if close == "by a call" else _switch_all_off()
    worker.join()
    assert bulb.lit_with_a[-1] == 0.8
    assert not bulb.is_lit
    assert bulb.is_closed
    refused: list[WrongState] = []

    def try_again() -> None:
        try:
            light.set_on(True)
        except WrongState as error:
            refused.append(error)

    late = threading.Thread(target=try_again, daemon=True)
    late.start()
    late.join(HANG_S)
    assert refused
