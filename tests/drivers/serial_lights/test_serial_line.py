"""A serial line comes back into step, whatever came late: shown with answers that all look alike."""

from __future__ import annotations

from collections.abc import Iterable

import pytest
import serial
from support.serial_stand_in import wire_to

from drivers.errors import DeviceError, DeviceTimeout
from drivers.serial_lights.line import Dialect, SerialLine, Wire
from simulated_devices.clock import ManualClock
from simulated_devices.wires.serial import LineDevice, LineFault, MemoryPort

DIALECT = Dialect("counter", end=b"\r\n", timeout_s=0.5)


class Counter(LineDevice):
    """Answers each question with its name, and how often it was asked."""

    def __init__(self) -> None:
        super().__init__(command_end=b"\r\n", answer_end=b"\n")
        self.asked: dict[str, int] = {}

    @property
    def is_lit(self) -> bool:
        return False

    def answer(self, command: str) -> Iterable[str]:
        if command.endswith("?"):
            self.asked[command] = self.asked.get(command, 0) + 1
            yield "me" if command == "n?" else "17" if command == "s?" else f"{command[:-1]}{self.asked[command]}"


@pytest.fixture
def device() -> Counter:
    return Counter()


@pytest.fixture
def line(device: Counter, clock: ManualClock) -> SerialLine:
    line = SerialLine("COM7", DIALECT, wire_to(device, clock))
    line.mark({"n?": "me", "s?": "17"})
    return line


def ask(line: SerialLine, question: str) -> str:
    return line.query(question)[0]


@pytest.mark.parametrize("delay_s", [0.51, 0.55, 0.7, 0.9])
def test_a_late_answer_is_thrown_away(line: SerialLine, device: Counter, delay_s: float) -> None:
    device.faults.append(LineFault("late", delay_s=delay_s))
    with pytest.raises(DeviceTimeout):
        ask(line, "a?")
    assert [ask(line, question) for question in ("a?", "b?", "a?")] == ["a2", "b1", "a3"]
    assert device.asked["n?"] == 1  # in step again, it is not asked every time


def test_a_marker_that_is_late_itself_is_not_mistaken_for_the_next(line: SerialLine, device: Counter) -> None:
    device.faults.append(LineFault("late", delay_s=1.2))
    for question in ("a?", "b?"):  # the second one does not get as far as being asked
        with pytest.raises(DeviceTimeout):
            ask(line, question)
    assert [ask(line, question) for question in ("b?", "b?", "c?")] == ["b1", "b2", "c1"]
    assert device.received == ["", "a?", "n?", "s?", "b?", "b?", "c?"]


def test_when_no_marker_is_left_it_waits_for_silence(line: SerialLine, device: Counter, clock: ManualClock) -> None:
    device.faults.append(LineFault("late", delay_s=2.2))
    for _ in range(3):
        with pytest.raises(DeviceTimeout):
            ask(line, "a?")
    assert device.received == ["", "a?", "n?", "s?"]
    start_s = clock.now()  # all answers come 0.7 s later, after the silence and the next question for the name
    assert [ask(line, question) for question in ("b?", "b?", "a?")] == ["b1", "b2", "a2"]
    assert clock.now() - start_s < 1
    assert device.received[4:] == ["n?", "b?", "b?", "a?"]


@pytest.mark.parametrize("kind", ["silence", "half", "garbage"])
def test_an_answer_that_never_comes(line: SerialLine, device: Counter, kind: str) -> None:
    device.faults.append(LineFault(kind))  # type: ignore[arg-type] # pytest knows no literals
    with pytest.raises(DeviceError):
        line.query("a?", "a[0-9]")
    assert ask(line, "a?") == "a2"


def test_what_comes_unasked_is_thrown_away(line: SerialLine, device: Counter) -> None:
    assert ask(line, "a?") == "a1"
    device.faults.append(LineFault("noise"))
    ask(line, "x?")  # takes the noise; its own answer comes unasked
    assert ask(line, "b?") == "b1"


def test_many_lines(line: SerialLine, device: Counter, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(device, "answer", lambda _: ["x1", "noise", "x2", "", "x3"])
    assert [match[1] for match in line.query_lines("x?", "x([0-9])", 3)] == ["1", "2", "3"]
    with pytest.raises(DeviceTimeout):
        line.query_lines("x?", "x([0-9])", 4)


class Chatter:
    """A port at which something sends without an end, and without a line's end."""

    in_waiting = 64

    def __init__(self, clock: ManualClock) -> None:
        self._clock = clock

    def read(self, size: int, /) -> bytes:
        self._clock.sleep(0.005)
        return b"\xff" * size

    def write(self, data: bytes, /) -> int:
        return len(data)

    def close(self) -> None:
        pass


def test_a_stream_without_an_end_is_no_hang(clock: ManualClock) -> None:
    line = SerialLine("COM7", DIALECT, Wire(lambda _port, **_settings: Chatter(clock), clock.now))
    start_s = clock.now()
    with pytest.raises(DeviceError, match="bad cable"):
        line.query("n?", "[a-z]+")
    assert clock.now() - start_s < 1


class Clogged(MemoryPort):
    """A port that takes half of one command, and the rest not in time."""

    is_clogged = False

    def write(self, data: bytes, /) -> int:
        if self.is_clogged:
            self.is_clogged = False
            super().write(data[: len(data) // 2])
            raise serial.SerialTimeoutException
        return super().write(data)


def test_half_a_command_does_not_spoil_the_next(device: Counter, clock: ManualClock) -> None:
    port = Clogged(device, clock)
    line = SerialLine("COM7", DIALECT, Wire(lambda _port, **_settings: port, clock.now))
    port.is_clogged = True
    with pytest.raises(DeviceTimeout, match="takes no commands"):
        line.command("set 1234")
    line.command("off")
    assert device.received[-1] == "off"


class Halting(MemoryPort):
    """A port of a computer that stands still for two seconds after each command."""

    def __init__(self, device: LineDevice, clock: ManualClock) -> None:
        super().__init__(device, clock)
        self._halting = clock

    def write(self, data: bytes, /) -> int:
        count = super().write(data)
        self._halting.sleep(2.0)
        return count


def test_a_computer_that_stood_still_hears_what_came_meanwhile(device: Counter, clock: ManualClock) -> None:
    line = SerialLine("COM7", DIALECT, Wire(lambda _port, **_settings: Halting(device, clock), clock.now))
    assert [ask(line, "a?"), ask(line, "b?")] == ["a1", "b1"]
    device.faults.append(LineFault("late", delay_s=2.03))
    assert ask(line, "a?") == "a2"
    device.faults.append(LineFault("silence"))
    with pytest.raises(DeviceTimeout):
        ask(line, "a?")
