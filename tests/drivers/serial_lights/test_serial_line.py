"""Resynchronisation of a serial line after faults, with answers that all look alike."""

from __future__ import annotations

from collections.abc import Iterable

import pytest
import serial
from support.serial_stand_in import wire_to
from support.stand_ins.serial import LineDevice, LineFault, MemoryPort

from drivers.errors import DeviceError, DeviceTimeout
from drivers.serial_lights._line import Dialect, SerialLine, Wire
from simulated_devices.clock import ManualClock

DIALECT = Dialect("counter", end=b"\r\n", timeout_s=0.5)


class Counter(LineDevice):
    """Answers each query with its text and its count."""

    def __init__(self) -> None:
        super().__init__(command_end=b"\r\n", answer_end=b"\n")
        self.asked: dict[str, int] = {}

    @property
    def is_lit(self) -> bool:
        return False

    @property
    def level(self) -> float:
        return 0.0

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
def test_late_answer_is_discarded(line: SerialLine, device: Counter, delay_s: float) -> None:
    device.faults.append(LineFault("late", delay_s=delay_s))
    with pytest.raises(DeviceTimeout):
        ask(line, "a?")
    assert [ask(line, question) for question in ("a?", "b?", "a?")] == ["a2", "b1", "a3"]
    assert device.asked["n?"] == 1  # not sent again once in step


def test_late_marker_is_not_taken_for_next_one(line: SerialLine, device: Counter) -> None:
    device.faults.append(LineFault("late", delay_s=1.2))
    for question in ("a?", "b?"):  # the second query is not even sent
        with pytest.raises(DeviceTimeout):
            ask(line, question)
    assert [ask(line, question) for question in ("b?", "b?", "c?")] == ["b1", "b2", "c1"]
    assert device.received == ["", "a?", "n?", "s?", "b?", "b?", "c?"]


def test_without_fresh_marker_it_waits_for_silence(line: SerialLine, device: Counter, clock: ManualClock) -> None:
    device.faults.append(LineFault("late", delay_s=2.2))
    for _ in range(3):
        with pytest.raises(DeviceTimeout):
            ask(line, "a?")
    assert device.received == ["", "a?", "n?", "s?"]
    start_s = clock.now()  # answers come 0.7 s late, after the silence and the next marker
    assert [ask(line, question) for question in ("b?", "b?", "a?")] == ["b1", "b2", "a2"]
    assert clock.now() - start_s < 1
    assert device.received[4:] == ["n?", "b?", "b?", "a?"]


class Chatter:
    """A port with endless input and no line end."""

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


def test_endless_stream_does_not_hang(clock: ManualClock) -> None:
    line = SerialLine("COM7", DIALECT, Wire(lambda _port, **_settings: Chatter(clock), clock.now))
    start_s = clock.now()
    with pytest.raises(DeviceError, match="bad cable"):
        line.query("n?", "[a-z]+")
    assert clock.now() - start_s < 1


class Clogged(MemoryPort):
    """A port that accepts half a command and times out."""

    is_clogged = False

    def write(self, data: bytes, /) -> int:
        if self.is_clogged:
            self.is_clogged = False
            super().write(data[: len(data) // 2])
            raise serial.SerialTimeoutException
        return super().write(data)


def test_half_sent_command_does_not_spoil_next(device: Counter, clock: ManualClock) -> None:
    port = Clogged(device, clock)
    line = SerialLine("COM7", DIALECT, Wire(lambda _port, **_settings: port, clock.now))
    port.is_clogged = True
    with pytest.raises(DeviceTimeout, match="takes no commands"):
        line.command("set 1234")
    line.command("off")
    assert device.received[-1] == "off"


class Halting(MemoryPort):
    """A port of a computer that stalls for two seconds after each command."""

    def __init__(self, device: LineDevice, clock: ManualClock) -> None:
        super().__init__(device, clock)
        self._halting = clock

    def write(self, data: bytes, /) -> int:
        count = super().write(data)
        self._halting.sleep(2.0)
        return count


def test_stalled_computer_still_reads_answer(device: Counter, clock: ManualClock) -> None:
    line = SerialLine("COM7", DIALECT, Wire(lambda _port, **_settings: Halting(device, clock), clock.now))
    assert [ask(line, "a?"), ask(line, "b?")] == ["a1", "b1"]
    device.faults.append(LineFault("late", delay_s=2.03))
    assert ask(line, "a?") == "a2"
    device.faults.append(LineFault("silence"))
    with pytest.raises(DeviceTimeout):
        ask(line, "a?")
