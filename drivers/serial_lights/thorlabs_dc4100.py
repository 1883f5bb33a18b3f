"""Thorlabs DC4100 and DC4104, four-channel LED drivers on a serial port: one channel of it, at constant current.

The protocol is that of Micro-Manager's adapter (DeviceAdapters/ThorlabsDCxxxx) and of the manual, Rev. 2.2. Commands
that set are not answered; `e?` tells whether they were carried out. Currents are whole milliamperes. All channels are
switched off when it is opened and when it is closed.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from dataclasses import dataclass

from drivers.device import Property
from drivers.discovery import DiscoveredDevice
from drivers.errors import BadValue, DeviceError, DeviceTimeout, WrongState
from drivers.light_source import LightSource
from drivers.range import Range
from drivers.serial_lights import ports as serial_ports
from drivers.serial_lights.line import Dialect, SerialLine, Wire
from drivers.serial_lights.ports import find_port
from drivers.serial_lights.settings import DC4100Settings

_DIALECT = Dialect("DC4100", end=b"\r\n")
_MODEL = r".*\b(DC4100|DC4104|LEDD4)\b.*"  # all that Micro-Manager accepts
_MILLIAMPERES = r"(\d{1,5})(?:\s*mA)?"
_ERROR = r"(?:\S+\s+)?(-?\d{1,6})\s*:\s*(.*)"
_MULTI_SELECTION, _CONSTANT_CURRENT = "0", "0"


def discover() -> tuple[DiscoveredDevice, ...]:
    """Return the serial ports where one may be; nothing is sent to it."""
    return serial_ports.discover("thorlabs_dc4100", "DC4100 or DC4104", ("dc4100", "dc4104", "thorlabs"))


@dataclass(frozen=True, slots=True)
class Status:
    """The status register, as far as it concerns one channel."""

    is_supply_bad: bool
    is_over_temperature: bool
    is_without_led: bool
    is_open: bool
    is_at_limit: bool

    @classmethod
    def decode(cls, register: int, channel: int) -> Status:
        """Take the odd bits, the states; the even bits only say what has changed since it was read."""
        bits = (1, 3, 5 + 2 * channel, 13 + 2 * channel, 21 + 2 * channel)
        return cls(*(bool(register >> bit & 1) for bit in bits))

    @property
    def fault(self) -> str:
        """Why there can be no light, in words for the bench, or nothing."""
        reasons = {
            "its power supply is out of range": self.is_supply_bad,
            "it is too hot and has switched all LEDs off; let it cool": self.is_over_temperature,
            "there is no LED at this channel; plug its head in": self.is_without_led,
            "the LED at this channel does not conduct; check its cable and head": self.is_open,
        }
        return "; ".join(reason for reason, holds in reasons.items() if holds)


class ThorlabsDC4100(LightSource):
    """One channel of a DC4100 or DC4104; the others stay off."""

    def __init__(
        self, settings: DC4100Settings, *, wire: Wire | None = None, sleep: Callable[[float], None] = time.sleep
    ) -> None:
        super().__init__(limit_a=settings.limit_a, sleep=sleep)
        self._channel = settings.channel
        self._is_wanted_lit = False
        self._line = SerialLine(settings.port or find_port(settings.serial_number), _DIALECT, wire or Wire())
        try:
            self._open()
        except BaseException:  # Ctrl-C, too
            self._line.close()
            raise
        self._begin()

    def _open(self) -> None:
        self._model = self._line.query("n?", _MODEL)[1]  # not another word before this is known
        self._line.command("o -1 0")
        self._firmware = self._line.query("v?")[0]
        self._serial_number = self._line.query("s?")[0]
        self._line.mark({"n?": _MODEL, "s?": re.escape(self._serial_number), "v?": re.escape(self._firmware)})
        self._error()  # forgets what others have done wrong
        self._choose("sm", _MULTI_SELECTION)
        self._choose("m", _CONSTANT_CURRENT)
        if fault := self._status().fault:
            raise WrongState(f"{self._where}: {fault}")
        self._wavelength_nm, self._head = self._tell("wl"), self._tell("hs")

    @property
    def name(self) -> str:
        """Maker, model, serial number and channel."""
        return f"Thorlabs {self._model} {self._serial_number} LED{self._channel + 1}"

    def properties(self) -> dict[str, Property]:
        """What every light tells, and what driver and head at this channel tell of themselves."""
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
                "is_at_limit": status.is_at_limit,
                "fault": status.fault,
            }

    @property
    def _where(self) -> str:
        return f"{self._line.where}, LED{self._channel + 1}"

    def _read_range(self) -> Range:
        return Range(0.0, min(self._ask_ma("ml"), self._ask_ma("l")) / 1000)

    def _read_current(self) -> float:
        return self._ask_ma("cc") / 1000

    def _set_current(self, current_a: float) -> float:
        asked_ma = int(current_a * 1000 + 1e-6)  # never above what was asked, but for rounding
        self._set(f"cc {self._channel} {asked_ma}")
        taken_ma = self._ask_ma("cc")
        if taken_ma != asked_ma:
            raise DeviceError(f"{self._where} was asked for {asked_ma} mA and set {taken_ma} mA")
        self._check_lit()
        return taken_ma / 1000

    def _is_lit(self) -> bool:
        self._check_lit()
        return self._is_output_on()

    def _switch(self, *, on: bool) -> None:
        if on:
            self._line.command(f"o {self._channel} 1")
            refusal = self._error()
            self._is_wanted_lit = True
            self._check_lit(refusal)
        else:
            self._is_wanted_lit = False
            for _ in range(2):  # a command can be lost
                self._line.command("o -1 0")
                self._error()
                if not self._is_output_on():
                    return
            raise DeviceError(f"{self._where} is still on, though it was told to switch off; unplug its head")

    def _close(self) -> None:
        self._line.close()

    def _check_lit(self, refusal: str = "") -> None:
        """Raise if the light should be on and is not."""
        if self._is_wanted_lit:
            if fault := self._status().fault:
                raise DeviceError(f"{self._where}: {fault}")
            if not self._is_output_on():
                raise DeviceError(f"{self._where} is off: {refusal or 'switched off at its front panel, or by itself'}")

    def _is_output_on(self) -> bool:
        return self._line.query(f"o? {self._channel}", "[01]")[0] == "1"

    def _status(self) -> Status:
        return Status.decode(int(self._line.query("r?", r"\d{1,10}")[0]), self._channel)

    def _choose(self, word: str, value: str) -> None:
        if self._line.query(f"{word}?", "[0-9]")[0] != value:
            self._set(f"{word} {value}")

    def _ask_ma(self, word: str) -> int:
        return int(self._line.query(f"{word}? {self._channel}", _MILLIAMPERES)[1])

    def _tell(self, word: str) -> str:
        """What not every head knows of itself; such a question is left unanswered."""
        try:
            return self._line.query(f"{word}? {self._channel}")[0]
        except DeviceTimeout:
            return ""

    def _set(self, command: str) -> None:
        """Send what is not answered, and ask whether it was carried out."""
        self._line.command(command)
        if refusal := self._error():
            raise BadValue(f"{self._where} refuses “{command}”: {refusal}")

    def _error(self) -> str:
        """Why the last command was refused, or nothing."""
        answer = self._line.query("e?", _ERROR)
        return "" if int(answer[1]) == 0 else f"{answer[2].strip()} (error {answer[1]})"
