"""Stand-in for the Thorlabs DC4100, with limits and faults.

Commands follow micro-manager/mmCoreAndDevices DeviceAdapters/ThorlabsDCxxxx, the status register the DC4100 manual
Rev. 2.2, page 28. Error numbers and texts are undocumented, and invented here.
"""

from collections.abc import Iterable
from dataclasses import dataclass

from support.stand_ins.serial import LineDevice

_ALL = -1
_VALUE_ERROR, _COMMAND_ERROR, _STATE_ERROR = 2, 1, 3


class _Refused(Exception):
    """A command is refused, with an error number."""

    def __init__(self, number: int, text: str) -> None:
        super().__init__(text)
        self.number = number


@dataclass(slots=True)
class Head:
    """Head at one channel."""

    maximum_ma: int = 1000
    limit_ma: int = 1000
    current_ma: int = 100
    brightness_percent: float = 10.0
    wavelength_nm: float = 455.0
    serial_number: str = "M00250001"
    is_plugged: bool = True
    is_open: bool = False
    is_on: bool = False


class DC4100Wire(LineDevice):
    """Four channels, with heads in the first two."""

    def __init__(self, name: str = "DC4100", *, is_empty_line_an_error: bool = False) -> None:
        super().__init__(command_end=b"\n", answer_end=b"\r\n")  # a carriage return before the line feed is harmless
        self.name = name
        self.heads = [Head(), Head(maximum_ma=350, limit_ma=200), Head(is_plugged=False), Head(is_plugged=False)]
        self.mode = 1  # left so: brightness, one LED at a time
        self.selection = 1
        self.is_hot = False
        self.refuses_next = False
        self.is_stuck_on = False  # a broken switch
        self._is_empty_line_an_error = is_empty_line_an_error
        self._error = (0, "No error")
        self._status_read = 0

    @property
    def is_lit(self) -> bool:
        """True state of the light."""
        return bool(self._lit())

    @property
    def level(self) -> float:
        """Highest current of a lit head, mA."""
        return max((head.current_ma for head in self._lit()), default=0)

    def _lit(self) -> list[Head]:
        return [head for head in self.heads if head.is_on and head.is_plugged and not head.is_open]

    def heat_up(self) -> None:
        """Become too hot: switch all LEDs off, to stay off."""
        self.is_hot = True
        for head in self.heads:
            head.is_on = False

    def answer(self, command: str) -> Iterable[str]:
        """Execute a command; only valid queries are answered."""
        word, *arguments = command.lower().split() or [""]
        if not word and not self._is_empty_line_an_error:
            return
        try:
            if word.endswith("?"):
                yield self._query(word, arguments)
            else:
                self._set(word, arguments)
        except _Refused as refusal:
            self._error = (refusal.number, str(refusal))

    def _query(self, word: str, arguments: list[str]) -> str:
        match word:
            case "e?":
                (number, text), self._error = self._error, (0, "No error")
                return f"ERROR {number}: {text}"
            case "r?":
                return str(self._status())
            case "n?" | "s?" | "v?" | "h?" | "sm?" | "m?" if not arguments:
                texts = {"n?": self.name, "s?": "M00266001", "v?": "1.8.4", "h?": "Thorlabs"}
                return texts.get(word) or str({"sm?": self.selection, "m?": self.mode}[word])
        head = self._head(arguments[0] if len(arguments) == 1 else "")
        values: dict[str, object] = {
            "o?": int(head.is_on),
            "cc?": head.current_ma,
            "bp?": head.brightness_percent,
            "l?": head.limit_ma,
            "ml?": head.maximum_ma,
            "wl?": head.wavelength_nm,
            "fb?": 3.5,
            "hs?": head.serial_number,
        }
        if word not in values:
            raise _Refused(_COMMAND_ERROR, "Unknown command")
        return str(values[word])

    def _set(self, word: str, arguments: list[str]) -> None:
        numbers = [self._number(argument) for argument in arguments]
        if self.refuses_next and not (word == "o" and numbers[-1:] == [0]):
            self.refuses_next = False
            raise _Refused(_VALUE_ERROR, "Value refused")
        match word, numbers:
            case "sm", [0 | 1 as selection]:
                self.selection = selection
            case "m", [0 | 1 | 2 as mode]:
                if any(head.is_on for head in self.heads):
                    raise _Refused(_STATE_ERROR, "Switch the LEDs off first")
                self.mode = mode
            case "o", [channel, 0 | 1 as on]:
                self._switch(channel, on=bool(on))
            case "cc", [channel, current_ma]:
                head = self._head(str(channel))
                self._check(current_ma, min(head.limit_ma, head.maximum_ma))
                head.current_ma = current_ma
            case "l", [channel, limit_ma]:
                head = self._head(str(channel))
                self._check(limit_ma, head.maximum_ma)
                head.limit_ma = limit_ma
            case _:
                raise _Refused(_COMMAND_ERROR, "Unknown command")

    def _switch(self, channel: int, *, on: bool) -> None:
        heads = [head for head in self.heads if head.is_plugged] if channel == _ALL else [self._head(str(channel))]
        if on and self.is_hot:
            raise _Refused(_STATE_ERROR, "Over temperature")
        if on and self.selection == 1:
            for other in self.heads:
                other.is_on = False
        for head in heads:
            if on and not head.is_plugged:
                raise _Refused(_STATE_ERROR, "No LED")
            if on or not self.is_stuck_on:
                head.is_on = on

    def _status(self) -> int:
        states = {1: False, 3: self.is_hot}
        for channel, head in enumerate(self.heads):
            states[5 + 2 * channel] = not head.is_plugged
            states[13 + 2 * channel] = head.is_open
            states[21 + 2 * channel] = head.is_on and head.current_ma >= head.limit_ma
        now = sum(1 << bit for bit, is_set in states.items() if is_set)
        changed = (now ^ self._status_read) >> 1  # the bit below each state flags a change since the last read
        self._status_read = now
        return now | changed

    def _head(self, channel: str) -> Head:
        number = self._number(channel)
        self._check(number, len(self.heads) - 1)
        return self.heads[number]

    @staticmethod
    def _number(text: str) -> int:
        try:
            return int(text)
        except ValueError:
            raise _Refused(_VALUE_ERROR, "Not a whole number") from None

    @staticmethod
    def _check(value: int, maximum: int) -> None:
        if not 0 <= value <= maximum:
            raise _Refused(_VALUE_ERROR, "Value out of range")
