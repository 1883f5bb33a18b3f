"""Stand-in for a USB Test and Measurement Class instrument, transfer by transfer, with faults.

Follows USBTMC 1.0 and IEEE 488.2: it keeps the tags, refuses malformed transfers, is confused by a transfer given up
without an abort, and drops an unread answer.
"""

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
    """The host times out."""


class StalledError(Exception):
    """The endpoint is halted."""


class GoneError(Exception):
    """The cable is unplugged."""


@dataclass(frozen=True, slots=True)
class UsbFault:
    """A fault of the next message or answer.

    `silence`: no answer; `late`: it is ready after `after` timeouts; `half`: it ends after its header; `wrong tag`: it
    answers another request; `garbage`: it is replaced; `deaf`: the next message times out; `stall`: it is refused;
    `unplug`: the cable is pulled after it.
    """

    kind: UsbFaultKind
    after: int = 1


class UsbtmcWire(ABC):
    """The instrument's end of the cable; subclasses define the commands."""

    def __init__(self, *, largest_answer: int = 1 << 16) -> None:
        self._largest_answer = largest_answer  # bytes of data in one transfer
        self._message = bytearray()
        self._answer = b""
        self._is_answer_begun = False
        self._later: tuple[int, bytes] | None = None
        self._request: tuple[int, int] | None = None  # awaited tag and size
        self._is_confused = False
        self._packets: deque[bytes] = deque()
        self._is_aborting = self._is_clearing = False
        self._is_out_halted = False
        self._out_tag = 0
        self.faults: deque[UsbFault] = deque()
        self.is_unplugged = False
        self.is_remote_enabled = self.is_remote = False  # allowed by the host; its front panel is locked
        self.can_remote = True  # by requests of the subclass USB488
        self.refuses_local = False
        self.missed_openings = 0  # until it answers
        self.transfers: list[bytes] = []  # all bulk-OUT transfers
        self.requests: list[tuple[int, int, int]] = []  # (request, value, index) on the control pipe

    @abstractmethod
    def receive(self, message: str) -> Iterable[str]:
        """Execute a message and return its answers."""

    @abstractmethod
    def interrupted(self) -> None:
        """React to an unread answer that a new message has replaced."""

    def bulk_out(self, data: bytes) -> None:
        """Receive one transfer."""
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
                self._run_message()
        elif kind == 2 and is_sound and length and len(data) == _HEADER.size:
            self._is_confused |= self._request is not None or bool(self._packets)
            self._request = (tag, length)
            self._fill()
        else:
            self._is_out_halted = True
            raise StalledError

    def bulk_in(self, size: int) -> bytes:
        """Return the packets of one read: as many as fit, up to a short one."""
        self._check()
        data = b""
        while self._packets and len(data) < size:
            packet = self._packets.popleft()
            if len(packet) > size - len(data):
                raise StalledError  # overflow of the host's buffer
            data += packet
            if len(packet) < _PACKET:
                return data
        if data:
            return data
        self._let_time_pass()
        raise NoAnswerError

    def control(self, kind: int, request: int, value: int, index: int, length: int) -> bytes:
        """Answer a class request."""
        self._check()
        self.requests.append((request, value, index))
        steps: dict[tuple[int, int], Callable[[int], bytes]] = {
            (0xA1, 7): self._capabilities,
            (0xA1, 5): self._clear,
            (0xA1, 6): self._check_clear,
            (0xA1, 160): self._set_remote,
            (0xA1, 161): self._go_to_local,
            (0xA2, 3): self._abort_in,
            (0xA2, 4): self._check_abort_in,
            (0xA2, 1): self._abort_out,
            (0xA2, 2): lambda _: bytes([_SUCCESS]),
        }
        if (kind, request) not in steps:
            raise StalledError
        return steps[kind, request](value).ljust(length, b"\0")[:length]

    def clear_halt(self) -> None:
        """Accept transfers again."""
        self._check()
        self._is_out_halted = False

    def plug_in(self) -> None:
        """Put the cable back; pending transfers are lost."""
        self.is_unplugged = False
        self._reset_in()
        self._message.clear()
        self._is_out_halted = False

    def _capabilities(self, _value: int) -> bytes:
        if self.missed_openings:
            self.missed_openings -= 1
            raise NoAnswerError
        return bytes([_SUCCESS, 0, 0x00, 0x01, 0x04, 0x01, *[0] * 8, 0x02 if self.can_remote else 0x00])

    def _set_remote(self, value: int) -> bytes:
        self.is_remote_enabled = self.is_remote = bool(value)
        return bytes([_SUCCESS])

    def _go_to_local(self, _value: int) -> bytes:
        if self.refuses_local:
            raise StalledError
        self.is_remote = False
        return bytes([_SUCCESS])

    def _clear(self, _value: int) -> bytes:
        self._reset_in()
        self._message.clear()
        self._is_clearing = self._is_out_halted = True
        self._packets.append(b"\xaa" * 10)  # in transit
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
        self._packets.append(b"\xbb" * 7)  # in transit
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

    def _run_message(self) -> None:
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
        """Send a ready answer to a waiting host."""
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
