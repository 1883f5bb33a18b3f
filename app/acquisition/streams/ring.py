"""Ring of slots in shared memory: one process writes, any number read, none waits.

Each record has a count, higher than that of the record before. A slot has twice the count of its record, and an odd
number while it is written. A reader copies a slot and looks at that before and after: what was overwritten meanwhile is
not returned. Nothing stays behind when the writer is killed: on Linux the memory has no name, and readers open it by
the writer's process; on Windows it lasts while a process has it open. Elsewhere it is a file. A slow reader loses
records and knows it; a dead one changes nothing.
"""

import mmap
import os
import secrets
import struct
import sys
from contextlib import suppress
from pathlib import Path

import numpy as np

from app.acquisition.serialization import Message

_MAGIC = b"svwfsR1\0"
_FACTS = struct.Struct("<8sQQ8s")  # magic, slots, bytes of a slot, serial
_HEADER_BYTES = _SLOT_HEADER_BYTES = 64
_COUNT_AT = 32  # of the newest record, in the header


class RingWriter:
    """Owns a ring; `name` is what readers find it by."""

    def __init__(self, slot_bytes: int, file: Path, *, slots: int = 8) -> None:
        """Make slots for records of a size."""
        self._slots, self._stride = slots, _SLOT_HEADER_BYTES + -(-slot_bytes // 64) * 64
        self._written = 0
        self._file: Path | None = None
        self._descriptor = -1
        serial = secrets.token_hex(4)  # the next ring, or that of a process in a container, may get the same descriptor
        size = _HEADER_BYTES + slots * self._stride
        if sys.platform == "linux":
            self._descriptor = os.memfd_create("svwfs ring")
            self.name = f"/proc/{os.getpid()}/fd/{self._descriptor}#{serial}"
        elif sys.platform == "win32":  # where a file that a reader has open could not be removed
            self.name = f"svwfs-{os.getpid()}-{size}#{serial}"
            self._memory = mmap.mmap(-1, size, tagname=self.name)
        else:
            self._file = file.with_name(f"{file.name}-{serial}")
            self._descriptor = os.open(self._file, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600)
            self.name = f"{self._file}#{serial}"
        if self._descriptor >= 0:
            os.ftruncate(self._descriptor, size)
            self._memory = mmap.mmap(self._descriptor, size)
        self._memory[: _FACTS.size] = _FACTS.pack(_MAGIC, slots, self._stride, serial.encode())
        self._view = memoryview(self._memory)
        self._count = np.ndarray((), np.uint64, self._view, _COUNT_AT)

    def has_room_for(self, message: Message) -> bool:
        """True if a record fits into a slot."""
        return message.nbytes <= self._stride - _SLOT_HEADER_BYTES

    def write(self, message: Message, count: int) -> None:
        """Write a record over the oldest one."""
        start = _HEADER_BYTES + self._written % self._slots * self._stride
        self._written += 1
        state = np.ndarray((2,), np.uint64, self._view, start)
        state[0] = 2 * count - 1
        message.write(self._view[start + _SLOT_HEADER_BYTES : start + self._stride])
        state[1] = message.nbytes
        state[0] = 2 * count
        self._count[...] = count

    def close(self) -> None:
        """Give the memory back; readers that have it open keep what they have."""
        del self._count
        self._view.release()
        with suppress(BufferError):  # an array of it is alive
            self._memory.close()
        if self._descriptor >= 0:
            os.close(self._descriptor)
        if self._file is not None:
            self._file.unlink(missing_ok=True)


class RingReader:
    """Reads the ring of a name; `OSError` if it is gone, `ValueError` if it is none of this version."""

    def __init__(self, name: str) -> None:
        file, _, serial = name.rpartition("#")
        if sys.platform == "win32":  # memory of zeros if the ring is gone
            self._memory = mmap.mmap(-1, int(file.rpartition("-")[2]), tagname=name, access=mmap.ACCESS_READ)
        else:
            descriptor = os.open(file, os.O_RDONLY)
            try:
                self._memory = mmap.mmap(descriptor, 0, access=mmap.ACCESS_READ)
            finally:
                os.close(descriptor)
        magic, self._slots, self._stride, found = _FACTS.unpack(self._memory[: _FACTS.size])
        expected = magic == _MAGIC and found == serial.encode()
        if not expected or len(self._memory) < _HEADER_BYTES + self._slots * self._stride:
            raise ValueError(f"{name} is no ring of this version")

    @property
    def count(self) -> int:
        """Count of the newest record."""
        return int.from_bytes(self._memory[_COUNT_AT : _COUNT_AT + 8], "little")

    def read(self, count: int) -> bytes | None:
        """A copy of the record with a count, from 1; None if it is overwritten, or is not there yet."""
        for start in range(_HEADER_BYTES, _HEADER_BYTES + self._slots * self._stride, self._stride):
            state, nbytes = struct.unpack_from("<QQ", self._memory, start)
            if state == 2 * count > 0 and nbytes <= self._stride - _SLOT_HEADER_BYTES:
                copy = self._memory[start + _SLOT_HEADER_BYTES : start + _SLOT_HEADER_BYTES + nbytes]
                (after,) = struct.unpack_from("<Q", self._memory, start)
                return copy if after == state else None
        return None

    def close(self) -> None:
        """Give the memory back."""
        self._memory.close()
