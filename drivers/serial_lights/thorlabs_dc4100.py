"""Thorlabs DC4100 and DC4104 LED drivers on a serial port: one channel at constant current.

The protocol follows Micro-Manager's adapter (DeviceAdapters/ThorlabsDCxxxx) and the manual, Rev. 2.2. Commands have no
answer; `e?` reports whether they were executed. Currents are whole milliamperes. Opening and closing switch off all
channels.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable

from drivers.device import DiscoveredDevice, Property, Range
from drivers.errors import DeviceError, DeviceTimeout, WrongState
from drivers.light_source import LedDriver
from drivers.serial_lights import DC4100Settings
from drivers.serial_lights._line import Dialect, SerialLine, Wire, find_port
from drivers.serial_lights._line import discover as discover_on_ports

_DIALECT = Dialect("DC4100", end=b"\r\n")
_MODEL = r".*\b(DC4100|DC4104|LEDD4)\b.*"  # as in Micro-Manager
_MILLIAMPERES = r"(\d{1,5})(?:\s*mA)?"
_ERROR = r"(?:\S+\s+)?(-?\d{1,6})\s*:\s*(.*)"
_MULTI_SELECTION, _CONSTANT_CURRENT = "0", "0"


def discover() -> tuple[DiscoveredDevice, ...]:
    """Return the serial ports that may lead to one; sends nothing."""
    return discover_on_ports("thorlabs_dc4100", "DC4100 or DC4104", ("dc4100", "dc4104", "thorlabs"))


def faults(register: int, channel: int) -> str:
    """Reasons for having no light, from the odd bits of the status register; the even ones flag changes."""
    states = {
        1: "its power supply is out of range",
        3: "it is too hot and has switched all LEDs off; let it cool",
        5 + 2 * channel: "there is no LED at this channel; plug its head in",
        13 + 2 * channel: "the LED at this channel does not conduct; check its cable and head",
    }
    return "; ".join(reason for bit, reason in states.items() if register >> bit & 1)


def is_at_limit(register: int, channel: int) -> bool:
    """True if the channel's current is at its limit."""
    return bool(register >> 21 + 2 * channel & 1)


class ThorlabsDC4100(LedDriver):
    """One channel of a DC4100 or DC4104; the others stay off."""

    _panel = "front panel"

    def __init__(
        self, settings: DC4100Settings, *, wire: Wire | None = None, sleep: Callable[[float], None] = time.sleep
    ) -> None:
        super().__init__(limit_a=settings.limit_a, sleep=sleep)
        self._channel = settings.channel
        self._switching = "o -1 0", f"o {self._channel} 1"
        self._line = SerialLine(settings.port or find_port(settings.serial_number), _DIALECT, wire or Wire())
        self._where = f"{self._line.where}, LED{self._channel + 1}"
        self._begin()

    def _identify(self) -> None:
        model = self._line.query("n?", _MODEL)[1]  # sends nothing else before this is known
        self._line.command("o -1 0")
        self._firmware = self._line.query("v?")[0]
        serial_number = self._line.query("s?")[0]
        self._name = f"Thorlabs {model} {serial_number} LED{self._channel + 1}"
        self._line.mark({"n?": _MODEL, "s?": re.escape(serial_number), "v?": re.escape(self._firmware)})
        self._error()  # clear old errors
        self._choose("sm", _MULTI_SELECTION)
        self._choose("m", _CONSTANT_CURRENT)
        if fault := self._fault():
            raise WrongState(f"{self._where}{fault}")
        self._wavelength_nm, self._head = self._query_head("wl"), self._query_head("hs")

    def properties(self) -> dict[str, Property]:
        """Properties of every light, and of driver and head at this channel."""
        common = super().properties()
        with self._guarded():
            status = self._status()
            return common | {
                "firmware": self._firmware,
                "channel": self._channel,
                "wavelength_nm": self._wavelength_nm,
                "head_serial_number": self._head,
                "head_maximum_a": self._ask_ma("ml") / 1000,
                "user_limit_a": self._ask_ma("l") / 1000,
                "is_at_limit": is_at_limit(status, self._channel),
                "fault": faults(status, self._channel),
            }

    def _read_range(self) -> Range:
        return Range(0.0, min(self._ask_ma("ml"), self._ask_ma("l")) / 1000)

    def _read_current(self) -> float:
        return self._ask_ma("cc") / 1000

    def _set_current(self, current_a: float) -> float:
        asked_ma = int(current_a * 1000 + 1e-6)  # never above the request, except for rounding
        self._execute(f"cc {self._channel} {asked_ma}")
        taken_ma = self._ask_ma("cc")
        if taken_ma != asked_ma:
            raise DeviceError(f"{self._where} set {taken_ma} mA instead of {asked_ma} mA")
        self._check_lit()
        return taken_ma / 1000

    def _close(self) -> None:
        self._line.close()

    def _fault(self) -> str:
        return f": {fault}" if (fault := faults(self._status(), self._channel)) else ""

    def _is_output_on(self) -> bool:
        return self._line.query(f"o? {self._channel}", "[01]")[0] == "1"

    def _status(self) -> int:
        return int(self._line.query("r?", r"\d{1,10}")[0])

    def _choose(self, word: str, value: str) -> None:
        if self._line.query(f"{word}?", "[0-9]")[0] != value:
            self._execute(f"{word} {value}")

    def _ask_ma(self, word: str) -> int:
        return int(self._line.query(f"{word}? {self._channel}", _MILLIAMPERES)[1])

    def _query_head(self, word: str) -> str:
        """Query a detail of the head; a head without it does not answer."""
        try:
            return self._line.query(f"{word}? {self._channel}")[0]
        except DeviceTimeout:
            return ""

    def _send(self, command: str) -> str:
        self._line.command(command)
        return self._error()

    def _error(self) -> str:
        """Return why the last command was refused, or an empty text."""
        answer = self._line.query("e?", _ERROR)
        return "" if int(answer[1]) == 0 else f"{answer[2].strip()} (error {answer[1]})"
