"""Stand-in for the Thorlabs DC2200 (SCPI over USBTMC), with limits and faults.

Headers, ranges and modes follow the manual, section 4.3.2 (`CCURent` has one R there, too), errors SCPI.
"""

import math
import re
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from support.light_log import LightLog
from support.stand_ins.usbtmc import UsbtmcWire

_MODES = ("CC", "CB", "PWM", "PULS", "IMOD", "EMOD", "TTL")
_QUEUE = 10  # errors


class _Refused(Exception):
    """A command is refused, with error number and text."""


_UNDEFINED = (-113, "Undefined header")
_CONFLICT = (-221, "Settings conflict")
_OUT_OF_RANGE = (-222, "Data out of range")


def header(pattern: str) -> re.Pattern[str]:
    """Compile a header in the manual's notation: lower case, nodes in brackets and the number 1 are optional."""
    nodes = []
    for bracket, short, rest, number in re.findall(r"(\[?):?([*A-Z]+)([a-z]*)(\d?)\]?", pattern):
        node = re.escape(short) + (f"(?:{rest.upper()})?" if rest else "") + ("1?" if number == "1" else number)
        nodes.append(f"(?::?{node})?" if bracket else f":?{node}")
    return re.compile("".join(nodes) + r"(\??)")


@dataclass(slots=True)
class Terminal:
    """Output with its head."""

    head: str
    maximum_a: float
    limit_a: float


class DC2200Wire(UsbtmcWire):
    """Two terminals with heads; the second one was left on, at constant brightness."""

    def __init__(self, serial_number: str = "M00331234", *, largest_answer: int = 1 << 16) -> None:
        super().__init__(largest_answer=largest_answer)
        self.serial_number = serial_number
        self.model = "DC2200"
        self.terminals = {
            1: Terminal("Thorlabs,M455L4,M00412345,1.0.0", 1.0, 1.0),
            2: Terminal("Thorlabs,M365F1,M00123456,1.0.0", 0.7, 0.5),
        }
        self.terminal, self.mode, self.is_output_on = 2, "CB", True
        self.current_a, self.ttl_a = 0.1, 0.1
        self.is_gate_high = False
        self.is_driver_hot = self.is_hot = False
        self.refuses_next = self.is_stuck_on = False
        self.undefined: set[str] = set()  # commands and queries that this firmware lacks
        self.noise_a = 0.0  # of the measured current
        self.received: list[str] = []
        self.log = LightLog()
        self._errors: deque[tuple[int, str]] = deque()
        self._commands: list[tuple[re.Pattern[str], Callable[[str], None] | None, Callable[[str], str] | None]] = [
            (header("*IDN"), None, lambda _: f"Thorlabs,{self.model},{self.serial_number},1.2.0"),
            (header("*CLS"), lambda _: self._errors.clear(), None),
            (header("SYSTem:ERRor[:NEXT]"), None, lambda _: self._next_error()),
            (header("OUTPut1[:STATe]"), self._switch, lambda _: str(int(self.is_output_on))),
            (header("OUTPut1:TERMinal"), self._choose, lambda _: str(self.terminal)),
            (header("OUTPut1:PROTection:TEMPerature:DRIVer:TRIPped"), None, lambda _: str(int(self.is_driver_hot))),
            (header("OUTPut1:PROTection:TEMPerature:HEAD:TRIPped"), None, lambda _: str(int(self.is_hot))),
            (header("SOURce1:MODE"), self._set_mode, lambda _: self.mode),
            (header("SOURce1:CCURent[:CURRent]"), self._set_current, lambda _: f"{self.current_a:.6E}"),
            (header("SOURce1:TTL[:CURRent]"), self._set_ttl, lambda _: f"{self.ttl_a:.6E}"),
            (header("SOURce1:CURRent:LIMit[:AMPLitude]"), self._set_limit, self._query_limit),
            (header("MEASure:CURRent"), None, lambda _: f"{self._flowing_a() + self.noise_a:.6E}"),
            (header("SENSe3:CURRent:DATA"), None, lambda _: f"{self._flowing_a() + self.noise_a:.6E}"),
            (header("SYSTem:TERMinal1:HTYPe"), None, lambda _: self.terminals[1].head),
            (header("SYSTem:TERMinal2:HTYPe"), None, lambda _: self.terminals[2].head),
        ]

    @property
    def is_lit(self) -> bool:
        """True state of the light, given a high gate."""
        return self.is_output_on

    def heat_up(self) -> None:
        """Heat the LED's head too much: switch the output off, to stay off."""
        self.is_hot, self.is_output_on = True, False

    def receive(self, message: str) -> Iterable[str]:
        """Execute the commands of a message."""
        self.received.append(message)
        for command in message.upper().split(";"):
            try:
                word, _, argument = command.strip().partition(" ")
                answer = self._execute(word, argument.strip())
                if answer is not None:
                    yield answer
            except _Refused as refusal:
                self._note(*refusal.args)
            self.log.note(is_on=self.is_lit, level=self._flowing_a())

    def interrupted(self) -> None:
        """Queue the error of IEEE 488.2."""
        self._note(-410, "Query INTERRUPTED")

    def _execute(self, word: str, argument: str) -> str | None:
        if word in self.undefined or f"{word} {argument}" in self.undefined:
            raise _Refused(*_UNDEFINED)
        for pattern, setter, getter in self._commands:
            if match := pattern.fullmatch(word):
                if match[1] and getter:
                    return getter(argument)
                if not match[1] and setter:
                    setter(argument)
                    return None
        raise _Refused(*_UNDEFINED)

    def _switch(self, argument: str) -> None:
        on = {"0": False, "OFF": False, "1": True, "ON": True}.get(argument)
        if on is None:
            raise _Refused(-104, "Data type error")
        if on and (self.is_driver_hot or self.is_hot or "no head" in self.terminals[self.terminal].head):
            raise _Refused(*_CONFLICT)
        self._refuse(may=on)
        if on or not self.is_stuck_on:
            self.is_output_on = on

    def _choose(self, argument: str) -> None:
        self._check_off()
        self.terminal = int(self._number(argument, 1, 2))
        limit_a = self._limit_a()
        self.current_a, self.ttl_a = min(self.current_a, limit_a), min(self.ttl_a, limit_a)

    def _set_mode(self, argument: str) -> None:
        self._check_off()
        mode = _MODES[int(argument) - 1] if argument in map(str, range(1, 8)) else argument
        if mode not in _MODES:
            raise _Refused(-104, "Data type error")
        self.mode = mode

    def _set_current(self, argument: str) -> None:
        self._refuse()
        self.current_a = self._number(argument, 0, self._limit_a())

    def _set_ttl(self, argument: str) -> None:
        self._refuse()
        self.ttl_a = self._number(argument, 0, self._limit_a())

    def _set_limit(self, argument: str) -> None:
        terminal = self.terminals[self.terminal]
        terminal.limit_a = self._number(argument, 0, terminal.maximum_a)

    def _query_limit(self, argument: str) -> str:
        terminal = self.terminals[self.terminal]
        values = {"": terminal.limit_a, "MIN": 0.0, "MAX": terminal.maximum_a}
        if argument not in values:
            raise _Refused(-104, "Data type error")
        return f"{values[argument]:.6E}"

    def _limit_a(self) -> float:
        return min(self.terminals[self.terminal].limit_a, self.terminals[self.terminal].maximum_a)

    def _flowing_a(self) -> float:
        return (self.ttl_a if self.mode == "TTL" else self.current_a) if self.is_output_on else 0.0

    def _check_off(self) -> None:
        if self.is_output_on:
            raise _Refused(*_CONFLICT)

    def _refuse(self, *, may: bool = True) -> None:
        if may and self.refuses_next:
            self.refuses_next = False
            raise _Refused(*_OUT_OF_RANGE)

    def _note(self, number: int, text: str) -> None:
        if len(self._errors) < _QUEUE:
            self._errors.append((number, text))
        else:
            self._errors[-1] = (-350, "Queue overflow")

    def _next_error(self) -> str:
        number, text = self._errors.popleft() if self._errors else (0, "No error")
        return f'{number:+d},"{text}"'

    @staticmethod
    def _number(argument: str, minimum: float, maximum: float) -> float:
        try:
            value = float(argument)
        except ValueError:
            raise _Refused(-104, "Data type error") from None
        if not math.isfinite(value) or not minimum <= value <= maximum:
            raise _Refused(*_OUT_OF_RANGE)
        return value
