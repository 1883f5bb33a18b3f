"""What stand-ins for devices on a serial port share: lines in, lines out, and the faults of such a line.

`LineDevice` is the device's end. A `MemoryPort` connects it to a driver in the same thread, on a clock that is turned
by hand: a timeout of half a second takes none. `simulated_devices.wires.pseudo_terminal` connects it to a real port.
"""

from __future__ import annotations

import errno
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from simulated_devices.clock import Clock

FaultKind = Literal["silence", "late", "half", "garbage", "noise", "deaf", "unplug"]


@dataclass(frozen=True, slots=True)
class LineFault:
    """What happens to one line.

    `silence`: the answer is lost; `late`: it comes after `delay_s`, and with it all later ones; `half`: its second half
    is lost; `garbage`: other bytes come instead of it; `noise`: a line of garbage comes before it; `deaf`: the next
    command is lost; `unplug`: the cable is pulled when the next command has been carried out.
    """

    kind: FaultKind
    delay_s: float = 0.0


GARBAGE = b"\xff\x00\x9c{3;\x1b"


class LineDevice(ABC):
    """A device that reads commands and answers some of them; its subclass knows the commands."""

    name = "a device"

    def __init__(self, *, command_end: bytes, answer_end: bytes) -> None:
        self._command_end, self._answer_end = command_end, answer_end
        self._unfinished = bytearray()
        self.faults: deque[LineFault] = deque()
        self.received: list[str] = []  # every complete command
        self.is_unplugged = False

    @property
    @abstractmethod
    def is_lit(self) -> bool:
        """Whether light comes out, whatever the device says."""

    @abstractmethod
    def answer(self, command: str) -> Iterable[str]:
        """Carry out a command and return the lines it is answered with."""

    def greeting(self) -> bytes:
        """What the device says when its port is opened."""
        return b""

    def receive(self, data: bytes) -> list[tuple[float, bytes]]:
        """Take bytes from the host; return what is sent back, and after how many seconds."""
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
    """A serial port as a driver sees it, with the device on its other end; one of its reads waits 20 ms."""

    def __init__(self, device: LineDevice, clock: Clock) -> None:
        self._device, self._clock = device, clock
        self._coming: deque[tuple[float, bytes]] = deque()  # when, what
        self._came = bytearray(device.greeting())
        self._is_closed = False

    @property
    def in_waiting(self) -> int:
        """How many bytes have come."""
        self._check()
        while self._coming and self._coming[0][0] <= self._clock.now():
            self._came += self._coming.popleft()[1]
        return len(self._came)

    def read(self, size: int, /) -> bytes:
        """Return what has come, after waiting a short time for it."""
        if not self.in_waiting:
            self._clock.sleep(0.02)
        data = bytes(self._came[: min(size, self.in_waiting)])
        del self._came[: len(data)]
        return data

    def write(self, data: bytes, /) -> int:
        """Send; the first write after the cable was pulled still succeeds, as it does on a real port."""
        if self._is_closed:
            raise OSError(errno.EBADF, "the port is closed")
        for delay_s, answer in self._device.receive(data):
            earliest = self._coming[-1][0] if self._coming else 0.0  # bytes do not overtake one another
            self._coming.append((max(earliest, self._clock.now() + delay_s), answer))
        return len(data)

    def close(self) -> None:
        """Let go; closing twice is allowed."""
        self._is_closed = True

    def _check(self) -> None:
        if self._is_closed or self._device.is_unplugged:
            raise OSError(errno.EIO, "Input/output error")
