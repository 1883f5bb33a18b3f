"""File object for HDF5, which crashes the process if it cannot write."""

import io
import os
from pathlib import Path
from typing import Any, Self


class HdfFile(io.RawIOBase):
    """An existing file opened for changes, whose writes never fail for HDF5.

    After the first failed write, for example on a full disk, what is written stays in memory, where HDF5 finds it
    again. `close` raises the error.
    """

    def __init__(self, path: Path) -> None:
        self._file = path.open("r+b", buffering=0)
        self._position = 0
        self._end = os.fstat(self._file.fileno()).st_size
        self._unwritten: list[tuple[int, bytes]] = []
        self._error: OSError | None = None

    def __enter__(self) -> Self:
        return self

    def seek(self, offset: int, whence: int = os.SEEK_SET, /) -> int:
        """Move to a position."""
        self._position = offset + {os.SEEK_SET: 0, os.SEEK_CUR: self._position, os.SEEK_END: self._end}[whence]
        return self._position

    def tell(self) -> int:
        """Return the position."""
        return self._position

    def write(self, data: Any, /) -> int:
        """Write all bytes, to the disk or else to the memory."""
        left, begin = memoryview(data).cast("B"), self._position
        if self._error is None:
            try:
                self._file.seek(begin)
                rest = left
                while rest:
                    rest = rest[self._file.write(rest) :]
            except OSError as error:
                self._error = error
        if self._error is not None:
            self._unwritten.append((begin, bytes(left)))
        self._position += len(left)
        self._end = max(self._end, self._position)
        return len(left)

    def readinto(self, buffer: Any, /) -> int:
        """Fill the buffer as far as the file goes."""
        target, begin = memoryview(buffer).cast("B"), self._position
        length = max(0, min(len(target), self._end - begin))
        self._file.seek(begin)
        stored = self._file.read(length).ljust(length, b"\0")
        target[:length] = stored
        for offset, data in self._unwritten:
            first, last = max(offset, begin), min(offset + len(data), begin + length)
            if first < last:
                target[first - begin : last - begin] = data[first - offset : last - offset]
        self._position += length
        return length

    def truncate(self, size: int | None = None, /) -> int:
        """Set the length."""
        self._end = self._position if size is None else size
        if self._error is None:
            try:
                self._file.truncate(self._end)
            except OSError as error:
                self._error = error
        return self._end

    def close(self) -> None:
        """Close the file; `OSError` if anything could not be written."""
        if not self.closed:
            self._file.close()
            super().close()
            if self._error is not None:
                raise self._error
