"""Safety rules of all lights, tested on a recording bulb."""

from __future__ import annotations

import gc
import os
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
    """The device at the other end of the wire."""

    def __init__(self, current_a: float = 0.3, *, is_lit: bool = False, lowest_a: float = 0.0) -> None:
        self.current_a, self.is_lit, self.lowest_a = current_a, is_lit, lowest_a
        self.lit_with_a: list[float] = []  # every current that flowed, in order
        self.faults: dict[str, BaseException] = {}  # by query or command
        self.is_closed = False

    def note(self) -> None:
        if self.is_lit:
            self.lit_with_a.append(self.current_a)

    def meet(self, what: str) -> None:
        if what in self.faults:
            raise self.faults[what]


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


def test_opening_switches_off_and_limits_current() -> None:
    bulb = Bulb(0.9, is_lit=True)
    light = BulbLight(bulb, limit_a=0.4)
    assert not bulb.is_lit
    assert light.current_a == 0.4
    assert light.current_range_a == Range(0.0, 0.4)
    light.set_on(True)
    with pytest.raises(BadValue, match=r"0\.5 is outside 0 \.\.\. 0\.4"):
        light.set_current(0.5)
    assert max(bulb.lit_with_a) == 0.4


def test_current_raised_at_the_device_is_limited_when_switching_on() -> None:
    bulb = Bulb(0.3)
    light = BulbLight(bulb, limit_a=0.4)
    bulb.current_a = 0.9
    light.set_on(True)
    assert max(bulb.lit_with_a) == light.current_a == 0.4


@pytest.mark.parametrize("current_a", [float("nan"), 2.0, 0.0])
def test_invalid_current_is_replaced_at_opening(current_a: float) -> None:
    with BulbLight(Bulb(current_a, lowest_a=0.1)) as light:
        light.current_range_a.check(light.current_a, "current_a")


def test_owner_limit_never_raises_head_limit() -> None:
    assert BulbLight(Bulb(), limit_a=5.0).current_range_a.maximum == 1.0


def test_fault_is_noted_as_off() -> None:
    bulb = Bulb()
    light = BulbLight(bulb)
    light.set_on(True)
    bulb.faults["current"] = DeviceTimeout("no answer")
    with pytest.raises(DeviceTimeout):
        _ = light.current_a
    assert not light._is_noted_lit


@pytest.mark.parametrize("limit_a", [0.05, float("nan")])
def test_limit_below_lowest_current_is_refused(limit_a: float) -> None:
    bulb = Bulb(lowest_a=0.1)
    with pytest.raises(BadValue, match="below the lowest current"):
        BulbLight(bulb, limit_a=limit_a)
    assert bulb.is_closed


def test_current_rises_in_steps_and_falls_at_once() -> None:
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
def test_any_fault_switches_off(fault: BaseException) -> None:
    bulb = Bulb()
    light = BulbLight(bulb)
    light.set_on(True)
    bulb.faults["current"] = fault
    with pytest.raises(type(fault)):
        _ = light.current_a
    assert not bulb.is_lit
    bulb.faults.clear()
    assert not light.is_on
    assert not light._is_noted_lit


def test_fault_during_ramp_switches_off() -> None:
    bulb = Bulb(0.8)
    light = BulbLight(bulb)
    bulb.faults["0.343"] = DeviceTimeout("no answer")  # the third of seven steps
    with pytest.raises(DeviceTimeout):
        light.set_on(True)
    assert bulb.lit_with_a
    assert not bulb.is_lit


def test_refusal_during_switch_on_leaves_it_off() -> None:
    bulb = Bulb(0.8)
    light = BulbLight(bulb)
    bulb.faults["0.343"] = BadValue("not that one")
    with pytest.raises(BadValue):
        light.set_on(True)
    assert (bulb.is_lit, light.is_on, light.current_a, light._is_noted_lit) == (False, False, 0.8, False)


def test_refused_ramp_step_restores_current() -> None:
    bulb = Bulb(0.2)
    light = BulbLight(bulb)
    light.set_on(True)
    bulb.faults["0.800"] = BadValue("too much")
    with pytest.raises(BadValue):
        light.set_current(0.8)
    assert (bulb.is_lit, light.current_a) == (True, 0.2)


@pytest.mark.parametrize("kind", [DeviceTimeout, Disconnected])
def test_failed_switch_off_asks_for_a_hand(kind: type[DeviceError]) -> None:
    bulb = Bulb()
    light = BulbLight(bulb)
    light.set_on(True)
    bulb.faults = {"current": kind("it is silent"), "off": kind("it is silent")}
    with pytest.raises(kind, match=r"^it is silent; the light may still be on: switch it off by hand$"):
        _ = light.current_a
    bulb.faults.clear()


@pytest.mark.parametrize("kind", [DeviceTimeout, Disconnected])
def test_close_reports_failed_switch_off_and_closes(kind: type[DeviceError]) -> None:
    bulb = Bulb()
    light = BulbLight(bulb)
    light.set_on(True)
    bulb.faults["off"] = kind("it is silent")
    with pytest.raises(kind, match="may still be on: switch it off by hand"):
        light.close()
    assert bulb.is_closed
    light.close()
    with pytest.raises(WrongState):
        light.set_on(True)


def test_failed_opening_releases_light() -> None:
    bulb = Bulb()
    bulb.faults["off"] = DeviceTimeout("it is silent")
    with pytest.raises(DeviceTimeout):
        BulbLight(bulb)
    assert bulb.is_closed


def test_light_that_goes_out_on_its_own_is_noted() -> None:
    bulb = Bulb()
    light = BulbLight(bulb)
    light.set_on(True)
    assert light._is_noted_lit
    bulb.is_lit = False  # too hot
    assert not light.is_on
    assert not light._is_noted_lit


def test_unreferenced_light_goes_off() -> None:
    bulb = Bulb()
    light = BulbLight(bulb)
    light.set_on(True)
    gone = weakref.ref(light)
    del light
    gc.collect()
    assert gone() is None
    assert (bulb.is_lit, bulb.is_closed) == (False, True)


def test_unopened_light_sends_nothing() -> None:
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
    signal.signal(signal.SIGINT, signal.default_int_handler)  # even if the tests ignore it
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
    "Ctrl-C": ("signal.raise_signal(signal.SIGINT); time.sleep(10)", -2 if os.name == "posix" else 0xC000013A),
    "a thread that hangs in it": (
        (
            "light._sleep = lambda _: time.sleep(60); hang = lambda: light.set_current(1.0);"
            " threading.Thread(target=hang, daemon=True).start(); time.sleep(0.2)"
        ),
        0,
    ),
}


@pytest.mark.parametrize("ending", ENDS, ids=ENDS)
def test_lights_go_off_at_interpreter_exit(ending: str) -> None:
    code, status = ENDS[ending]
    program = textwrap.dedent(PROGRAM.format(tests=[str(TESTS), str(Path(__file__).parent)]) + "    " + code + "\n")
    ended = subprocess.run(  # noqa: S603 - this interpreter
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=HANG_S, check=False
    )
    said = ended.stdout.split()
    assert "lit" in said
    assert said[-1] == "dark", ended.stderr
    assert ended.returncode == status


@pytest.mark.posix
def test_forked_process_leaves_light_on() -> None:
    code = "if not os.fork(): sys.exit(light.close())\n    os.wait(); print('then', flush=True)"
    program = textwrap.dedent(PROGRAM.format(tests=[str(TESTS), str(Path(__file__).parent)]) + "    " + code + "\n")
    ended = subprocess.run(  # noqa: S603 - this interpreter
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=HANG_S, check=True
    )
    said = ended.stdout.split()
    assert said[said.index("then") - 1] == "lit"
    assert said[-1] == "dark"


@pytest.mark.parametrize("close", ["at the interpreter's exit", "by a call"])
def test_close_from_another_thread_waits(close: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A running command finishes first; none can follow."""
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
