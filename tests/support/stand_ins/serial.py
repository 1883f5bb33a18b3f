"""Base of serial stand-ins: lines in, lines out, and line faults.

`MemoryPort` connects a `LineDevice` to a driver in the same thread, on a manual clock.
"""

import errno
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from simulated_devices.clock import Clock
from support.light_log import LightLog

FaultKind = Literal["silence", "late", "half", "garbage", "noise", "deaf", "unplug"]


@dataclass(frozen=True, slots=True)
class LineFault:
    """A fault of one line.

    `silence`: the answer is lost; `late`: it and all later ones come after `delay_s`; `half`: its second half is lost;
    `garbage`: it is replaced; `noise`: a line of garbage precedes it; `deaf`: the next command is lost; `unplug`: the
    cable is pulled after the next command.
    """

    kind: FaultKind
    delay_s: float = 0.0


GARBAGE = b"\xff\x00\x9c{3;\x1b"


class LineDevice(ABC):
    """A device that reads commands and answers some of them; subclasses define the commands."""

    name = "a device"

    def __init__(self, *, command_end: bytes, answer_end: bytes) -> None:
        self._command_end, self._answer_end = command_end, answer_end
        self._unfinished = bytearray()
        self.faults: deque[LineFault] = deque()
        self.received: list[str] = []  # every complete command
        self.log = LightLog()
        self.is_unplugged = False

    @property
    @abstractmethod
    def is_lit(self) -> bool:
        """True state of the light."""

    @property
    @abstractmethod
    def level(self) -> float:
        """Current or brightness of what is lit; 0 if nothing is."""

    @abstractmethod
    def answer(self, command: str) -> Iterable[str]:
        """Execute a command and return the lines of its answer."""

    def greeting(self) -> bytes:
        """Output when the port is opened."""
        return b""

    def receive(self, data: bytes) -> list[tuple[float, bytes]]:
        """Take bytes from the host; return the answers with their delays in s."""
        self._unfinished += data
        sent: list[tuple[float, bytes]] = []
        while (end := self._unfinished.find(self._command_end)) >= 0 and not self.is_unplugged:
            command = bytes(self._unfinished[:end]).decode("ascii", "replace").strip()
            del self._unfinished[: end + len(self._command_end)]
            if self.faults and self.faults[0].kind == "deaf":
                self.faults.popleft()
                continue
            self.received.append(command)
            lines = list(self.answer(command))
            self.log.note(is_on=self.is_lit, level=self.level)
            if self.faults and self.faults[0].kind == "unplug":
                self.faults.popleft()
                self.is_unplugged = True
                return []
            sent += [self._send(line) for line in lines]
        return sent

    def _send(self, line: str) -> tuple[float, bytes]:
        data = line.encode("ascii") + self._answer_end
        fault = self.faults.popleft() if self.faults and self.faults[0].kind not in {"deaf", "unplug"} else None
        if fault is None:
            return 0.0, data
        faulty = {
            "silence": b"",
            "late": data,
            "half": data[: len(line) // 2],
            "garbage": GARBAGE + self._answer_end,
            "noise": GARBAGE + self._answer_end + data,
        }
        return fault.delay_s if fault.kind == "late" else 0.0, faulty[fault.kind]


class MemoryPort:
    """A serial port to the device, as a driver sees it; a read waits up to 20 ms."""

    def __init__(self, device: LineDevice, clock: Clock) -> None:
        self._device, self._clock = device, clock
        self._pending: deque[tuple[float, bytes]] = deque()  # (time, bytes)
        self._received = bytearray(device.greeting())
        self._is_closed = False

    @property
    def in_waiting(self) -> int:
        """Number of received bytes."""
        self._check()
        while self._pending and self._pending[0][0] <= self._clock.now():
            self._received += self._pending.popleft()[1]
        return len(self._received)

    def read(self, size: int, /) -> bytes:
        """Return received bytes, after waiting a short time for some."""
        if not self.in_waiting:
            self._clock.sleep(0.02)
        data = bytes(self._received[: min(size, self.in_waiting)])
        del self._received[: len(data)]
        return data

    def write(self, data: bytes, /) -> int:
        """Send; as on a real port, the first write after the cable was pulled still succeeds."""
        if self._is_closed:
            raise OSError(errno.EBADF, "the port is closed")
        for delay_s, answer in self._device.receive(data):
            earliest = self._pending[-1][0] if self._pending else 0.0  # bytes stay in order
            self._pending.append((max(earliest, self._clock.now() + delay_s), answer))
        return len(data)

    def close(self) -> None:
        """Close; twice is allowed."""
        self._is_closed = True

    def _check(self) -> None:
        if self._is_closed or self._device.is_unplugged:
            raise OSError(errno.EIO, "Input/output error")
