"""Thorlabs DC2200, LED driver on USB: one of its two terminals, constant or gated by TTL.

Commands follow the manual, section 4.3, in the short forms of Thorlabs' driver (`SOUR:CCUR`, with one R). Where manual,
Thorlabs' example and public code differ, the first query that the device knows is used. After each command,
`SYST:ERR?` reports whether it was executed. Opening and closing switch the output off. With `gate = "ttl"` the light
follows the modulation input while on: connected to the camera's exposure output, it shines only during exposures.
"""

import re
import time
from collections.abc import Callable

from usb.backend import IBackend

from drivers.device import DiscoveredDevice, Property, Range, choose
from drivers.errors import DeviceError, Disconnected, Unsupported, WrongState
from drivers.light_source import LedDriver
from drivers.usb_lights import DC2200Settings
from drivers.usb_lights import _usbtmc as usbtmc
from drivers.usb_lights._usbtmc import Usbtmc

_VENDOR_ID, _PRODUCT_IDS = 0x1313, (0x80C8, 0x80C0)  # the second one if firmware updates are enabled
_STEP_A = 1e-4  # resolution of the commands
_ERROR = re.compile(r'([+-]?\d+),\s*"?([^"]*)"?')
_MOST_ERRORS = 32  # more than the queue holds
_UNDEFINED = re.compile(r"\(error -1\d\d\)$")  # SCPI's command errors, such as -113, undefined header
_CURRENT = {"CC": ("SOUR:CCUR:CURR?", "SOUR:CCUR?"), "TTL": ("SOUR:TTL:CURR?", "SOUR:TTL?")}  # by mode
_LIMIT = ("SOUR:CURR:LIM:AMPL?", "SOUR:CURR:LIM?")
_MAXIMUM = ("SOUR:CURR:LIM:AMPL? MAX", "SOUR:CURR:LIM? MAX")
_MEASURED = ("SENS3:CURR:DATA?", "MEAS:CURR?")
_TRIPS = {
    "OUTP:PROT:TEMP:DRIV:TRIP?": "its driver is too hot",
    "OUTP:PROT:TEMP:HEAD:TRIP?": "the LED's head is too hot",
}


def discover(backend: IBackend | None = None) -> tuple[DiscoveredDevice, ...]:
    """Return the connected ones; raise `Unsupported` if libusb is missing. Sends nothing."""
    return tuple(
        DiscoveredDevice(
            kind="light",
            driver="thorlabs_dc2200",
            description=f"Thorlabs DC2200 {instrument.serial_number}".rstrip(),
            settings={"serial_number": instrument.serial_number} if instrument.serial_number else {},
            missing=instrument.problem,
        )
        for instrument in usbtmc.instruments(_VENDOR_ID, _PRODUCT_IDS, backend)
    )


class ThorlabsDC2200(LedDriver):
    """One terminal of a DC2200."""

    _panel, _switching = "screen", ("OUTP 0", "OUTP 1")

    def __init__(
        self, settings: DC2200Settings, *, backend: IBackend | None = None, sleep: Callable[[float], None] = time.sleep
    ) -> None:
        super().__init__(limit_a=settings.limit_a, sleep=sleep)
        self._terminal, self._gate = settings.terminal, settings.gate
        self._mode = "CC" if settings.gate == "internal" else "TTL"
        instruments = usbtmc.instruments(_VENDOR_ID, _PRODUCT_IDS, backend)
        if len(instruments) == 1 and instruments[0].problem:
            raise DeviceError(instruments[0].problem)
        names = [(each.serial_number or each.problem,) for each in instruments]
        instrument = instruments[choose(settings.serial_number, names, what="DC2200", setting="serial_number")]
        self._where = f"the DC2200 {instrument.serial_number}"
        self._usb = Usbtmc(instrument, what=self._where, sleep=sleep)
        self._begin()

    def _identify(self) -> None:
        answer = self._usb.query("*IDN?")
        parts = [part.strip() for part in answer.split(",")]
        if len(parts) != 4 or parts[1] != "DC2200":
            raise DeviceError(f"{self._where} identifies itself as {answer[:60]!r}, which is no DC2200")
        maker, model, self._serial_number, self._firmware = parts
        self._name = f"{maker} {model} {self._serial_number} terminal {self._terminal}"
        self._usb.write("OUTP 0")
        self._usb.write("*CLS")
        if self._number("OUTP:TERM?") != self._terminal:
            self._execute(f"OUTP:TERM {self._terminal}")
        head = self._known(f"SYST:TERM{self._terminal}:HTYP?")
        self._head = self._usb.query(head) if head else "unknown"
        if "no head" in self._head:
            raise WrongState(f"there is no LED at terminal {self._terminal} of {self._where}; plug its head in")
        self._execute(f"SOUR:MODE {self._mode}")
        self._current, self._limit = self._known(*_CURRENT[self._mode]), self._known(*_LIMIT)
        if not self._current or not self._limit:
            raise Unsupported(
                f"{self._where} reports no current or no limit of it, as the firmware {self._firmware} should"
            )
        self._maximum, self._measured = self._known(*_MAXIMUM), self._known(*_MEASURED)
        self._trips = {question: words for question, words in _TRIPS.items() if self._known(question)}
        optional = {"head": head, "head's maximum": self._maximum, "measured current": self._measured}
        optional |= {words: question if question in self._trips else "" for question, words in _TRIPS.items()}
        self._unknown = ", ".join(what for what, question in optional.items() if not question)

    def _known(self, *questions: str) -> str:
        """Return the first query that the device knows, or an empty text; it does not answer an unknown one."""
        for question in questions:
            try:
                self._usb.query(question)
            except Disconnected:
                raise
            except DeviceError:
                if not _UNDEFINED.search(self._error()):
                    raise
            else:
                return question
        return ""

    def properties(self) -> dict[str, Property]:
        """Properties of every light, and of driver and head."""
        common = super().properties()
        with self._guarded():
            own: dict[str, Property] = {
                "firmware": self._firmware,
                "terminal": self._terminal,
                "gate": self._gate,
                "head": self._head,
                "user_limit_a": self._number(self._limit),
                "fault": self._trip(),
                "commands": ", ".join(filter(None, (self._current, self._limit, self._maximum, self._measured))),
                "not known to it": self._unknown,
            }
            if self._maximum:
                own["head_maximum_a"] = self._number(self._maximum)
            if self._measured:
                own["measured_current_a"] = self._number(self._measured, is_signed=True)
            return common | own

    def _read_range(self) -> Range:
        return Range(0.0, min(self._number(limit) for limit in (self._limit, self._maximum) if limit))

    def _read_current(self) -> float:
        return self._number(self._current)

    def _set_current(self, current_a: float) -> float:
        asked_a = int(current_a / _STEP_A + 1e-6) * _STEP_A  # never above the request, except for rounding
        self._execute(f"{self._current.rstrip('?')} {asked_a:.4f}")
        taken_a = self._read_current()
        if abs(taken_a - asked_a) > 0.01 * asked_a + 0.001:  # more than its own resolution
            raise DeviceError(f"{self._where} set {taken_a:g} A instead of {asked_a:g} A")
        self._check_lit()
        return taken_a

    def _close(self) -> None:
        self._usb.close()

    def _fault(self) -> str:
        return f" has switched off: {trip}; let it cool" if (trip := self._trip()) else ""

    def _trip(self) -> str:
        """Return why it has switched off on its own, or an empty text."""
        return "; ".join(words for question, words in self._trips.items() if self._number(question))

    def _is_output_on(self) -> bool:
        return self._number("OUTP?") == 1

    def _number(self, question: str, *, is_signed: bool = False) -> float:
        """Query a finite number, not negative unless it is signed, as a measurement of nothing can be."""
        answer = self._usb.query(question)
        words = {"ON": 1.0, "OFF": 0.0}
        if answer in words:
            return words[answer]
        if not re.fullmatch(r"[+-]?\d+(\.\d*)?([eE][+-]?\d{1,2})?", answer) or (answer[0] == "-" and not is_signed):
            raise DeviceError(f"{self._where} answered “{question}” with {answer[:60]!r}")
        return float(answer)

    def _execute(self, command: str) -> None:
        self._usb.write("*CLS")  # clear old errors
        super()._execute(command)

    def _send(self, command: str) -> str:
        self._usb.write(command)
        return self._error()

    def _error(self) -> str:
        """Empty the error queue; return the oldest error, or an empty text."""
        oldest = ""
        for _ in range(_MOST_ERRORS):
            answer = self._usb.query("SYST:ERR?")
            match = _ERROR.fullmatch(answer)
            if match is None:
                raise DeviceError(f"{self._where} answered “SYST:ERR?” with {answer[:60]!r}")
            if int(match[1]) == 0:
                return oldest
            oldest = oldest or f"{match[2]} (error {match[1]})"
        raise DeviceError(f"{self._where} reports errors without end, first {oldest}")
