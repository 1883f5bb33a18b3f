"""A stand-in for an instrument of the USB Test and Measurement Class, transfer by transfer, with its faults.

Written from the class specification (USBTMC 1.0) and IEEE 488.2: it keeps the tags, refuses what is malformed, stays
confused when a transfer is given up without being aborted, and drops an answer that nobody fetched.
"""

from __future__ import annotations

import struct
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Literal

UsbFaultKind = Literal["silence", "late", "half", "wrong tag", "garbage", "deaf", "stall", "unplug"]

_HEADER = struct.Struct("<BBBBLB3s")
_PACKET = 64  # bytes; full speed
_SUCCESS, _PENDING, _FAILED, _NOT_IN_PROGRESS = 0x01, 0x02, 0x80, 0x81


class NoAnswerError(Exception):
    """The host waits in vain."""


class StalledError(Exception):
    """The endpoint is halted."""


class GoneError(Exception):
    """The cable is out."""


@dataclass(frozen=True, slots=True)
class UsbFault:
    """What happens to the next message or answer.

    `silence`: there is no answer; `late`: it is ready when the host has given up `after` times; `half`: it breaks off
    after its header; `wrong tag`: it says that it answers another request; `garbage`: it is nonsense; `deaf`: the next
    message is not taken in time; `stall`: it is refused; `unplug`: the cable is pulled when it has been carried out.
    """

    kind: UsbFaultKind
    after: int = 1


class UsbtmcWire(ABC):
    """The instrument's end of the cable; its subclass knows the commands."""

    def __init__(self, *, largest_answer: int = 1 << 16) -> None:
        self._largest_answer = largest_answer  # bytes of data that it sends in one transfer
        self._message = bytearray()
        self._answer = b""
        self._is_answer_begun = False
        self._later: tuple[int, bytes] | None = None
        self._request: tuple[int, int] | None = None  # tag and size that the host waits for
        self._is_confused = False
        self._packets: deque[bytes] = deque()
        self._is_aborting = self._is_clearing = False
        self._is_out_halted = False
        self._out_tag = 0
        self.faults: deque[UsbFault] = deque()
        self.is_unplugged = False
        self.transfers: list[bytes] = []  # all that came on bulk-OUT
        self.requests: list[tuple[int, int, int]] = []  # request, value and index on the control pipe

    @abstractmethod
    def receive(self, message: str) -> Iterable[str]:
        """Carry out a message and return its answers."""

    @abstractmethod
    def interrupted(self) -> None:
        """An answer was thrown away, because a new message came before it was fetched."""

    def bulk_out(self, data: bytes) -> None:
        """Take one transfer."""
        self._check()
        fault = self._take("deaf", "stall")
        if fault == "deaf":
            raise NoAnswerError
        if self._is_out_halted or fault == "stall":
            self._is_out_halted = True
            raise StalledError
        self.transfers.append(data)
        kind, tag, inverse, zero, length, attributes, _ = _HEADER.unpack_from(data.ljust(_HEADER.size, b"\0"))
        is_sound = tag and inverse == tag ^ 0xFF and not zero and tag != self._out_tag and len(data) % 4 == 0
        self._out_tag = tag
        if kind == 1 and is_sound and 0 < length <= len(data) - _HEADER.size < length + 4:
            self._message += data[_HEADER.size : _HEADER.size + length]
            if attributes & 1:
                self._carry_out()
        elif kind == 2 and is_sound and length and len(data) == _HEADER.size:
            self._is_confused |= self._request is not None or bool(self._packets)
            self._request = (tag, length)
            self._fill()
        else:
            self._is_out_halted = True
            raise StalledError

    def bulk_in(self, size: int) -> bytes:
        """Return one read's worth of packets: as many as fit, up to a short one."""
        self._check()
        data = b""
        while self._packets and len(data) < size:
            packet = self._packets.popleft()
            if len(packet) > size - len(data):
                raise StalledError  # the host's buffer overflows
            data += packet
            if len(packet) < _PACKET:
                return data
        if data:
            return data
        self._let_time_pass()
        raise NoAnswerError

    def control(self, kind: int, request: int, value: int, index: int, length: int) -> bytes:
        """Answer a request of the class."""
        self._check()
        self.requests.append((request, value, index))
        steps: dict[tuple[int, int], Callable[[int], bytes]] = {
            (0xA1, 7): self._tell_capabilities,
            (0xA1, 5): self._clear,
            (0xA1, 6): self._check_clear,
            (0xA2, 3): self._abort_in,
            (0xA2, 4): self._check_abort_in,
            (0xA2, 1): self._abort_out,
            (0xA2, 2): lambda _: bytes([_SUCCESS]),
        }
        if (kind, request) not in steps:
            raise StalledError
        return steps[kind, request](value).ljust(length, b"\0")[:length]

    def clear_halt(self) -> None:
        """Take transfers again."""
        self._check()
        self._is_out_halted = False

    def plug_in(self) -> None:
        """Put the cable back; whatever was under way is forgotten."""
        self.is_unplugged = False
        self._reset_in()
        self._message.clear()
        self._is_out_halted = False

    def _tell_capabilities(self, _value: int) -> bytes:
        return bytes([_SUCCESS, 0, 0x00, 0x01, 0x04, 0x01])

    def _clear(self, _value: int) -> bytes:
        self._reset_in()
        self._message.clear()
        self._is_clearing = self._is_out_halted = True
        self._packets.append(b"\xaa" * 10)  # was on its way
        return bytes([_SUCCESS])

    def _check_clear(self, _value: int) -> bytes:
        if not self._is_clearing:
            raise StalledError
        if self._packets:
            return bytes([_PENDING, 1])
        self._is_clearing = False
        return bytes([_SUCCESS, 0])

    def _abort_in(self, tag: int) -> bytes:
        if self._request is None or self._request[0] != tag:
            return bytes([_NOT_IN_PROGRESS if self._request is None else _FAILED, self._out_tag])
        self._request, self._is_confused, self._is_aborting = None, False, True
        self._packets.append(b"\xbb" * 7)  # was on its way
        return bytes([_SUCCESS, tag])

    def _check_abort_in(self, _value: int) -> bytes:
        if not self._is_aborting:
            raise StalledError
        if self._packets:
            return bytes([_PENDING, 1])
        self._is_aborting = False
        return bytes([_SUCCESS])

    def _abort_out(self, tag: int) -> bytes:
        is_in_progress = tag == self._out_tag or bool(self._message)
        self._message.clear()
        self._is_out_halted = True
        return bytes([_SUCCESS if is_in_progress else _NOT_IN_PROGRESS, tag])

    def _reset_in(self) -> None:
        self._answer, self._later, self._request, self._out_tag = b"", None, None, 0
        self._is_answer_begun = self._is_confused = self._is_aborting = False
        self._packets.clear()

    def _carry_out(self) -> None:
        message = bytes(self._message).decode("ascii", "replace").strip()
        self._message.clear()
        if self._answer:
            self._answer, self._is_answer_begun = b"", False
            self.interrupted()
        answer = ";".join(self.receive(message))
        if self._take("unplug"):
            self.is_unplugged = True
            raise GoneError
        if not answer:
            return
        data = answer.encode("ascii") + b"\n"
        fault = self.faults[0] if self.faults else None
        if fault and fault.kind in {"silence", "late"}:
            self.faults.popleft()
            if fault.kind == "late":
                self._later = (fault.after, data)
        elif fault and fault.kind == "garbage":
            self.faults.popleft()
            self._answer = b"\xff\x00{"
        else:
            self._answer = data

    def _fill(self) -> None:
        """Send what there is to the host that waits for it."""
        if self._request is None or not self._answer or self._is_confused:
            return
        tag, size = self._request
        data = self._answer[: min(size, self._largest_answer)]
        self._answer = self._answer[len(data) :]
        fault = self._take("wrong tag", "half")
        if fault == "wrong tag":
            tag = tag % 255 + 1
        transfer = _HEADER.pack(2, tag, tag ^ 0xFF, 0, len(data), int(not self._answer), b"\0\0\0")
        transfer += b"" if fault == "half" else data
        transfer += bytes(-len(transfer) % 4)
        packets = [transfer[start : start + _PACKET] for start in range(0, len(transfer), _PACKET)]
        self._packets.extend(packets if len(packets[-1]) < _PACKET else [*packets, b""])
        self._request = None

    def _let_time_pass(self) -> None:
        if self._later is not None:
            count, data = self._later
            self._later = (count - 1, data)
            if count <= 1:
                self._later, self._answer = None, data
                self._fill()

    def _take(self, *kinds: UsbFaultKind) -> UsbFaultKind | None:
        if self.faults and self.faults[0].kind in kinds:
            return self.faults.popleft().kind
        return None

    def _check(self) -> None:
        if self.is_unplugged:
            raise GoneError
