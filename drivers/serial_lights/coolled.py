"""CoolLED pE-300, pE-340fura and pE-4000 illuminators on a serial port over USB: one channel.

Commands follow CoolLED's manual DOC-038 and Micro-Manager's adapters. Brightness is in percent: `full_current_a` is the
nominal current at 100 %. The devices also send lines unasked, and their answers to commands are undocumented. So after
each command the state of all channels is queried until it is as requested.
"""

import re
import time
from collections.abc import Callable
from dataclasses import dataclass

from drivers.device import DiscoveredDevice, Property, Range
from drivers.errors import BadValue, DeviceError, Unsupported
from drivers.light_source import LightSource
from drivers.serial_lights import CoolLEDSettings
from drivers.serial_lights._line import Dialect, SerialLine, Wire, find_port
from drivers.serial_lights._line import discover as discover_on_ports

_DIALECT = Dialect("CoolLED", end=b"\r", baudrate=57600)
_MODEL = r"XMODEL[:=\s]*(.*pE-(300|340|4000).*)"
_STATE = r"CSS((?:[A-H][SX][NF][0-9]{3}){1,8})"  # E to H are those of an expansion box
_LAMP = r"LAM:([A-D]):([0-9]{3,4})"  # CoolLED documents no wavelengths of E to H
_ATTEMPTS, _LOAD_POLLS, _PAUSE_S = 5, 20, 0.05


def discover() -> tuple[DiscoveredDevice, ...]:
    """Return the serial ports that may lead to one; sends nothing."""
    return discover_on_ports("coolled", "CoolLED pE-300 or pE-4000", ("coolled", "pe-300", "pe-4000"))


@dataclass(frozen=True, slots=True)
class Channel:
    """State of one channel."""

    is_selected: bool
    is_on: bool
    percent: int


class CoolLED(LightSource):
    """One channel; the others are deselected and stay off."""

    def __init__(
        self, settings: CoolLEDSettings, *, wire: Wire | None = None, sleep: Callable[[float], None] = time.sleep
    ) -> None:
        super().__init__(limit_a=settings.limit_a, sleep=sleep)
        self._channel, self._full_a = settings.channel, settings.full_current_a
        self._wanted_nm = settings.wavelength_nm
        self._is_wanted_lit = False
        self._line = SerialLine(settings.port or find_port(settings.serial_number), _DIALECT, wire or Wire())
        self._begin()

    def _identify(self) -> None:
        answer = self._line.query("XMODEL", _MODEL)
        model = f"pE-{answer[2]}"
        self._name = f"CoolLED {model} channel {self._channel}"
        self._line.mark({"XMODEL": _MODEL})
        self._switch(on=False)
        channels = self._state()
        if self._channel not in channels:
            raise BadValue(f"{self._line.where} has the channels {', '.join(channels)}, but no {self._channel}")
        self._wavelengths_nm: dict[str, int] = {}
        if model == "pE-4000":
            self._load()
        elif self._wanted_nm is not None:
            raise Unsupported(f"only a pE-4000 can load a wavelength; leave wavelength_nm out for a {model}")

    def properties(self) -> dict[str, Property]:
        """Properties of every light, and of this channel."""
        own: dict[str, Property] = {"channel": self._channel, "full_current_a": self._full_a}
        if self._channel in self._wavelengths_nm:
            own["wavelength_nm"] = self._wavelengths_nm[self._channel]
        return super().properties() | own

    def _read_range(self) -> Range:
        return Range(0.0, self._full_a)

    def _read_current(self) -> float:
        return self._state()[self._channel].percent * self._full_a / 100

    def _set_current(self, current_a: float) -> float:
        percent = int(100 * current_a / self._full_a + 1e-6)  # never above the request, except for rounding
        self._execute(f"C{self._channel}I{percent}", lambda channels: channels[self._channel].percent == percent)
        if self._is_wanted_lit:
            self._check_lit(self._state())
        return percent * self._full_a / 100

    def _load(self) -> None:
        """Query the loaded wavelengths, and load the wanted one into the channel."""
        wavelength_nm = self._wanted_nm
        self._wavelengths_nm = self._lamps()
        if wavelength_nm is None or self._wavelengths_nm.get(self._channel) == wavelength_nm:
            return
        self._line.command(f"LOAD:{wavelength_nm}")
        for _ in range(_LOAD_POLLS):
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
                self._execute("CSF", lambda channels: not any(channel.is_on for channel in channels.values()))
            except BadValue as refusal:
                raise DeviceError(f"{self._line.where} is still on after the command to switch off") from refusal
            return
        for letter in self._state():
            wanted = letter == self._channel
            self._execute(f"C{letter}{'S' if wanted else 'X'}", _is_selected(letter, wanted=wanted))
        self._execute("CSN", lambda channels: channels[self._channel].is_on)
        self._is_wanted_lit = True

    def _close(self) -> None:
        self._line.close()

    def _check_lit(self, channels: dict[str, Channel]) -> None:
        """Raise if the light should be on but is off."""
        if not channels[self._channel].is_on:
            raise DeviceError(f"{self._line.where} is off: it was switched off at its pod, or on its own")

    def _execute(self, command: str, is_done: Callable[[dict[str, Channel]], bool]) -> None:
        """Send a command and query the state until it is done."""
        for _ in range(_ATTEMPTS):
            self._line.command(command)  # repeated, as a command can be lost
            channels = self._state()
            if is_done(channels):
                return
            self._sleep(_PAUSE_S)
        raise BadValue(f"{self._line.where} does not execute “{command}”")

    def _state(self) -> dict[str, Channel]:
        text = self._line.query("CSS?", _STATE)[1]
        parts = re.findall(r"(.)(.)(.)(...)", text)
        channels = {letter: Channel(s == "S", n == "N", int(percent)) for letter, s, n, percent in parts}
        if any(channel.percent > 100 for channel in channels.values()):
            raise DeviceError(f"{self._line.where} reports more than 100 %: {text}")
        return channels


def _is_selected(letter: str, *, wanted: bool) -> Callable[[dict[str, Channel]], bool]:
    return lambda channels: channels[letter].is_selected == wanted
