"""CoolLED pE-300 and pE-4000, LED illuminators on a serial port over USB: one channel, in percent of its full light.

Their commands are those of CoolLED's manual DOC-038 and of Micro-Manager's adapters. They know no current: the setting
`full_current_a` says which nominal current is meant by 100 %, so that the rest of the program sees one kind of light.
They also speak unasked, when they are opened and when somebody turns a knob on the control pod; and what they answer to
commands is not documented. So every command is followed by the question for the state of all channels, until that is as
it was asked for.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from dataclasses import dataclass

from drivers.device import Property
from drivers.discovery import DiscoveredDevice
from drivers.errors import BadValue, DeviceError, Unsupported
from drivers.light_source import LightSource
from drivers.range import Range
from drivers.serial_lights import ports as serial_ports
from drivers.serial_lights.line import Dialect, SerialLine, Wire
from drivers.serial_lights.ports import find_port
from drivers.serial_lights.settings import CoolLEDSettings

_DIALECT = Dialect("CoolLED", end=b"\r", timeout_s=0.5)
_MODEL = r"XMODEL[:=\s]*(.*pE-(300|4000).*)"
_STATE = r"CSS((?:[A-D][SX][NF][0-9]{3}){1,4})"
_LAMP = r"LAM:([A-D]):([0-9]{3,4})"
_ORDERS, _LOADINGS, _PAUSE_S = 5, 20, 0.05  # how often, and after what pause, it is looked whether it was done


def discover() -> tuple[DiscoveredDevice, ...]:
    """Return the serial ports where one may be; nothing is sent to it."""
    return serial_ports.discover("coolled", "CoolLED pE-300 or pE-4000", ("coolled", "pe-300", "pe-4000"))


@dataclass(frozen=True, slots=True)
class Channel:
    """The state of one channel."""

    is_selected: bool
    is_on: bool
    percent: int


class CoolLED(LightSource):
    """One channel of a pE-300 or pE-4000; the others are deselected, and stay off."""

    def __init__(
        self, settings: CoolLEDSettings, *, wire: Wire | None = None, sleep: Callable[[float], None] = time.sleep
    ) -> None:
        super().__init__(limit_a=settings.limit_a, sleep=sleep)
        self._channel, self._full_a = settings.channel, settings.full_current_a
        self._is_wanted_lit = False
        self._line = SerialLine(settings.port or find_port(settings.serial_number), _DIALECT, wire or Wire())
        try:
            self._open(settings.wavelength_nm)
        except BaseException:  # Ctrl-C, too
            self._line.close()
            raise
        self._begin()

    def _open(self, wavelength_nm: int | None) -> None:
        answer = self._line.query("XMODEL", _MODEL)
        self._model = f"pE-{answer[2]}"
        self._line.mark({"XMODEL": _MODEL})
        self._switch(on=False)
        channels = self._state()
        if self._channel not in channels:
            raise BadValue(f"{self._line.where} has the channels {', '.join(channels)}, but no {self._channel}")
        self._wavelengths_nm: dict[str, int] = {}
        if self._model == "pE-4000":
            self._load(wavelength_nm)
        elif wavelength_nm is not None:
            raise Unsupported("only a pE-4000 can load a wavelength; leave wavelength_nm out for a pE-300")

    @property
    def name(self) -> str:
        """Maker, model and channel."""
        return f"CoolLED {self._model} channel {self._channel}"

    def properties(self) -> dict[str, Property]:
        """What every light tells, and what this one is."""
        own: dict[str, Property] = {"channel": self._channel, "full_current_a": self._full_a}
        if self._channel in self._wavelengths_nm:
            own["wavelength_nm"] = self._wavelengths_nm[self._channel]
        return super().properties() | own

    def _read_range(self) -> Range:
        return Range(0.0, self._full_a)

    def _read_current(self) -> float:
        return self._state()[self._channel].percent * self._full_a / 100

    def _set_current(self, current_a: float) -> float:
        percent = int(100 * current_a / self._full_a + 1e-6)  # never above what was asked, but for rounding
        self._order(f"C{self._channel}I{percent}", lambda channels: channels[self._channel].percent == percent)
        if self._is_wanted_lit:
            self._check_lit(self._state())
        return percent * self._full_a / 100

    def _load(self, wavelength_nm: int | None) -> None:
        """See what the channels are loaded with, and change it where that is asked for."""
        self._wavelengths_nm = self._lamps()
        if wavelength_nm is None or self._wavelengths_nm.get(self._channel) == wavelength_nm:
            return
        self._line.command(f"LOAD:{wavelength_nm}")
        for _ in range(_LOADINGS):
            self._sleep(_PAUSE_S)
            self._wavelengths_nm = self._lamps()
            if self._wavelengths_nm.get(self._channel) == wavelength_nm:
                return
        has = ", ".join(f"{letter} has {length_nm} nm" for letter, length_nm in self._wavelengths_nm.items())
        raise BadValue(f"{self._line.where} does not load {wavelength_nm} nm into channel {self._channel}: {has}")

    def _lamps(self) -> dict[str, int]:
        return {lamp[1]: int(lamp[2]) for lamp in self._line.query_lines("LAMS", _LAMP, 4)}

    def _is_lit(self) -> bool:
        channels = self._state()
        if self._is_wanted_lit:
            self._check_lit(channels)
        return any(channel.is_on for channel in channels.values())

    def _switch(self, *, on: bool) -> None:
        self._is_wanted_lit = False
        if not on:
            try:
                self._order("CSF", lambda channels: not any(channel.is_on for channel in channels.values()))
            except BadValue as refusal:
                raise DeviceError(f"{self._line.where} is still on, though it was told to switch off") from refusal
            return
        for letter in self._state():
            wanted = letter == self._channel
            self._order(f"C{letter}{'S' if wanted else 'X'}", _is_selected(letter, wanted=wanted))
        self._order("CSN", lambda channels: channels[self._channel].is_on)
        self._is_wanted_lit = True

    def _close(self) -> None:
        self._line.close()

    def _check_lit(self, channels: dict[str, Channel]) -> None:
        """Raise if the light should be on and is not."""
        if not channels[self._channel].is_on:
            raise DeviceError(f"{self._line.where} is off: switched off at its pod, or by itself")

    def _order(self, command: str, is_done: Callable[[dict[str, Channel]], bool]) -> None:
        """Send a command and ask for the state, until that is as it should be."""
        for _ in range(_ORDERS):
            self._line.command(command)  # again: a command can be lost
            channels = self._state()
            if is_done(channels):
                return
            self._sleep(_PAUSE_S)
        raise BadValue(f"{self._line.where} does not carry out “{command}”")

    def _state(self) -> dict[str, Channel]:
        """Ask for the state of all channels."""
        text = self._line.query("CSS?", _STATE)[1]
        parts = re.findall(r"(.)(.)(.)(...)", text)
        channels = {letter: Channel(s == "S", n == "N", int(percent)) for letter, s, n, percent in parts}
        if any(channel.percent > 100 for channel in channels.values()):
            raise DeviceError(f"{self._line.where} tells of more than 100 %: {text}")
        return channels


def _is_selected(letter: str, *, wanted: bool) -> Callable[[dict[str, Channel]], bool]:
    return lambda channels: channels[letter].is_selected == wanted
