"""Stand-in for CoolLED's pE-300, pE-340fura and pE-4000, with unasked lines and faults.

Commands follow micro-manager/mmCoreAndDevices DeviceAdapters/CoolLEDpE300 and CoolLEDpE4000. Answers to commands are
undocumented; `echo` chooses among plausible ones.
"""

import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from support.stand_ins.serial import LineDevice

_LAMPS_NM = {"A": (365, 385, 405, 435), "B": (460, 470, 490, 500), "C": (525, 550, 580, 595), "D": (635, 660, 740, 770)}


@dataclass(slots=True)
class Lamp:
    """One channel."""

    is_selected: bool = True  # left so
    is_on: bool = False
    percent: int = 20
    wavelength_nm: int = 0


class CoolLEDWire(LineDevice):
    """A pE-4000 with four channels or, with an expansion box, eight, or a pE-300 with three; the second one is on."""

    def __init__(
        self,
        model: str = "pE-4000",
        *,
        echo: Literal["nothing", "command", "channel", "state"] = "channel",
        has_expansion_box: bool = False,
    ) -> None:
        super().__init__(command_end=b"\r", answer_end=b"\r\n")
        self.name, self._echo = model, echo
        letters = ("ABCDEFGH" if has_expansion_box else "ABCD") if model == "pE-4000" else "ABC"
        self.lamps = {letter: Lamp(wavelength_nm=_LAMPS_NM.get(letter, (0,))[0]) for letter in letters}
        self.lamps["B"].is_on = True
        self.refuses_next = self.is_stuck_on = False
        self._refused = ""  # until another command comes
        self.unasked: list[str] = []  # lines that come before the next answer

    @property
    def is_lit(self) -> bool:
        """True state of the light."""
        return any(lamp.is_on for lamp in self.lamps.values())

    @property
    def level(self) -> float:
        """Highest brightness of a lit channel, percent."""
        return max((lamp.percent for lamp in self.lamps.values() if lamp.is_on), default=0)

    def greeting(self) -> bytes:
        """Two lines on opening the port."""
        return b"CoolLED " + self.name.encode() + b"\r\nSystem ready\r\n"

    def turn_knob(self, letter: str, percent: int) -> None:
        """Turn a knob on the control pod."""
        self.lamps[letter].percent = percent
        self.unasked.append(self._channel(letter))

    def answer(self, command: str) -> Iterable[str]:
        """Execute a command; unknown ones are ignored."""
        unasked, self.unasked = self.unasked, []
        yield from unasked
        if command == "XMODEL":
            yield f"XMODEL:{self.name}"
        elif command == "XVER":
            yield from ("XVER=MB 1.3.1", "XVER=HW 1", "XVER=DT 2", "XVER=PD 1.2.0")
        elif command == "CSS?":
            yield self._state()
        elif command == "LAMS" and self.name == "pE-4000":
            yield from (
                f"LAM:{letter}:{lamp.wavelength_nm}" for letter, lamp in self.lamps.items() if lamp.wavelength_nm
            )
        elif (match := re.fullmatch(r"C([A-H])\?", command)) and match[1] in self.lamps:
            yield self._channel(match[1])
        elif letter := self._set(command):
            answers = {"command": command, "channel": self._channel(letter), "state": self._state()}
            yield from [answers[self._echo]] if self._echo in answers else []

    def _set(self, command: str) -> str:
        """Execute a setting; return its channel, or an empty text if invalid."""
        if self.refuses_next and command != "CSF":
            self.refuses_next = False
            self._refused = command
        if command == self._refused:
            return ""
        self._refused = ""
        if command in {"CSN", "CSF"}:
            for lamp in self.lamps.values():
                if lamp.is_selected and not (self.is_stuck_on and command == "CSF"):
                    lamp.is_on = command == "CSN"
            return "A"
        if (match := re.fullmatch(r"LOAD:(\d{3})", command)) and self.name == "pE-4000":
            wavelength_nm = int(match[1])
            letters = [letter for letter, lengths_nm in _LAMPS_NM.items() if wavelength_nm in lengths_nm]
            for letter in letters:
                self.lamps[letter].wavelength_nm = wavelength_nm
            return "".join(letters)
        if (match := re.fullmatch(r"C([A-H])(S|X|I([0-9]{1,3}))", command)) and match[1] in self.lamps:
            return match[1] if self._change(self.lamps[match[1]], match[2], match[3]) else ""
        return ""

    def _change(self, lamp: Lamp, word: str, percent: str | None) -> bool:
        if percent is None:
            lamp.is_selected = word == "S"
            lamp.is_on &= lamp.is_selected
        elif int(percent) > 100:
            return False
        else:
            lamp.percent = int(percent)
        return True

    def _state(self) -> str:
        return "CSS" + "".join(self._channel(letter)[1:] for letter in self.lamps)

    def _channel(self, letter: str) -> str:
        lamp = self.lamps[letter]
        return f"C{letter}{'S' if lamp.is_selected else 'X'}{'N' if lamp.is_on else 'F'}{lamp.percent:03d}"
