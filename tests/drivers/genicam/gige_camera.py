"""GigE Vision camera with any GenICam description: registers over GVCP, frames over GVSP.

Aravis's own fake camera cannot take another description with other registers, and sends few pixel formats. This one
stores what is written, at any address, and sends the bytes that a test gives it as a frame.
"""

from __future__ import annotations

import selectors
import socket
import struct
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final, Self

from support.patience import udp_socket

ADDRESS: Final = "127.0.0.3"
XML_ADDRESS: Final = 0x2000_0000

_PORT: Final = 3956
_PACKET_BYTES: Final = 1400
_OVERHEAD_BYTES: Final = 36  # of IP, UDP and GVSP, in a packet
_INTERVAL_S: Final = 0.005  # between frames
_CAPABILITY, _WRITE_MEMORY = 0x0934, 1 << 1
_INVALID_ADDRESS, _WRITE_PROTECT = 0x8003, 0x8005  # GEV_STATUS
_TICKS: Final = 0x0940  # of the timestamp, Hz
_CONTROL, _STREAM_PORT, _PACKET_SIZE, _STREAM_HOST = 0x0A00, 0x0D00, 0x0D04, 0x0D18


@dataclass(frozen=True)
class Image:
    """A frame as it goes over the wire."""

    stored: bytes
    rows: int
    columns: int
    pixel_format: int = 0x01080001
    row_padding_bytes: int = 0


@dataclass
class GigeCamera:
    """A camera in a thread of this process, to be opened by its address."""

    xml: bytes
    vendor: str = "Maker"
    model: str = "Model"
    image: Callable[[GigeCamera], Image] = lambda _: Image(bytes(64), 8, 8)  # taken for each frame
    start_address: int = -1  # acquisition runs while this register is not 0
    locked: frozenset[int] = frozenset()  # addresses of write-protected registers
    unreadable: frozenset[int] = frozenset()  # addresses of registers that cannot be read
    after_write: Callable[[GigeCamera], None] = lambda _: None  # what the firmware adapts
    default: int = 0  # of a byte that was never written
    memory: dict[int, int] = field(default_factory=dict)  # bytes by address
    refused: list[int] = field(default_factory=list)  # addresses of refused writes

    def __post_init__(self) -> None:
        url = f"Local:camera.xml;{XML_ADDRESS:x};{len(self.xml):x}".encode()
        for address, text in ((0x48, self.vendor.encode()), (0x68, self.model.encode()), (0xD8, b"1"), (0x200, url)):
            self.store(address, text.ljust(512 if address == 0x200 else 16 if address == 0xD8 else 32, b"\0"))
        for address, number in ((0, 0x10002), (4, 0x80000001), (0x600, 1), (0x904, 1), (_TICKS, 10**9)):
            self.set_register(address, number)
        for address in (_TICKS - 4, _CONTROL, _STREAM_PORT, _STREAM_HOST):
            self.set_register(address, 0)
        self.set_register(_CAPABILITY, _WRITE_MEMORY)
        self.set_register(_PACKET_SIZE, _PACKET_BYTES)
        self._frame_id = 0
        self._is_over = False
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> Self:
        self._socket = udp_socket((ADDRESS, _PORT))
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._is_over = True
        self._thread.join()
        self._socket.close()

    def register(self, address: int) -> int:
        """Return the number in a register of four bytes."""
        return int.from_bytes(self.stored(address, 4), "big")

    def set_register(self, address: int, number: int) -> None:
        """Put a number into a register of four bytes."""
        self.store(address, number.to_bytes(4, "big"))

    def store(self, address: int, content: bytes) -> None:
        """Put bytes into the memory."""
        self.memory.update(enumerate(content, address))

    def stored(self, address: int, size: int) -> bytes:
        """Return bytes of the memory or of the description."""
        if XML_ADDRESS <= address < XML_ADDRESS + len(self.xml):
            start = address - XML_ADDRESS
            return self.xml[start : start + size].ljust(size, b"\0")
        return bytes(self.memory.get(each, self.default) for each in range(address, address + size))

    def _run(self) -> None:
        with selectors.DefaultSelector() as poll:
            poll.register(self._socket, selectors.EVENT_READ)
            due_s = time.monotonic()
            while not self._is_over:
                is_running = self.start_address >= 0 and self.register(self.start_address) != 0
                if poll.select(max(0.0, due_s - time.monotonic()) if is_running else 0.02):
                    self._answer(*self._socket.recvfrom(2048))
                if is_running and (time_s := time.monotonic()) >= due_s:
                    due_s = time_s + _INTERVAL_S
                    self._send(self.image(self), time_s)

    def _answer(self, packet: bytes, sender: tuple[str, int]) -> None:
        command, _, identifier = struct.unpack_from(">HHH", packet, 2)
        body, status, answer = packet[8:], 0, b""
        if command == 0x0002:  # discovery
            answer = self.stored(0, 0xF8)
        elif command == 0x0080:  # read registers
            answer = b"".join(self.stored(address, 4) for (address,) in struct.iter_unpack(">I", body))
        elif command == 0x0082:  # write registers
            for address, number in struct.iter_unpack(">II", body):
                status = self._write(address, number.to_bytes(4, "big"))
            answer = struct.pack(">HH", 0, len(body) // 8)
        elif command == 0x0084:  # read memory
            address, _, size = struct.unpack(">IHH", body)
            status = _INVALID_ADDRESS if address in self.unreadable else 0
            answer = b"" if status else body[:4] + self.stored(address, size)
        elif command == 0x0086:  # write memory
            status = self._write(struct.unpack_from(">I", body)[0], body[4:])
            answer = struct.pack(">HH", 0, len(body) - 4)
        else:
            return
        self._socket.sendto(struct.pack(">HHHH", status, command + 1, len(answer), identifier) + answer, sender)

    def _write(self, address: int, content: bytes) -> int:
        """Store what a client writes; return the status."""
        if address in self.locked:
            self.refused.append(address)
            return _WRITE_PROTECT
        self.store(address, content)
        self.after_write(self)
        return 0

    def _send(self, image: Image, time_s: float) -> None:
        """Send a frame taken at a time, which delays of this thread do not change."""
        host, port = socket.inet_ntoa(self.stored(_STREAM_HOST, 4)), self.register(_STREAM_PORT) & 0xFFFF
        if port == 0:
            return
        self._frame_id = self._frame_id % 65535 + 1
        size = (self.register(_PACKET_SIZE) & 0xFFFF) - _OVERHEAD_BYTES
        shape = (image.pixel_format, image.columns, image.rows, 0, 0, image.row_padding_bytes, 0)
        packets = [(1, struct.pack(">HHQIIIIIHH", 0, 1, round(1e9 * time_s), *shape))]  # leader
        packets += [(3, image.stored[i : i + size]) for i in range(0, len(image.stored), size)]
        packets += [(2, struct.pack(">II", 1, image.rows))]  # trailer
        for index, (content, body) in enumerate(packets):
            header = struct.pack(">HHI", 0, self._frame_id, content << 24 | index)
            self._socket.sendto(header + body, (host, port))
