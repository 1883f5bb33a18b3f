"""An array in a Zarr v3 store that grows by one frame after another, each a chunk, and so a file, of its own.

Zarr's own library makes the store. The chunks, which are nothing but the values, little-endian, are written and read
here: that takes a tenth of the library's time, in which the live path could not run; it can tell a frame that is
missing from one of zeros; and it can read what is still growing, whatever length the store has said so far. At each
call of the operating system another thread may take its turn, for 5 ms: a frame is written with as few as can be.
"""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from typing import Any, Literal, Self, TypeAlias

import numpy as np
import zarr
from numpy.typing import NDArray

from app.errors import InputError, RunError
from app.files import atomic_write

Separator: TypeAlias = Literal["/", "."]  # between the parts of a chunk's name

_METADATA = "zarr.json"
_STEP = 4096  # frames by which an array grows
_WRITE = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | getattr(os, "O_BINARY", 0)
_CODECS = [{"name": "bytes", "configuration": {"endian": "little"}}]


def is_array(path: Path) -> bool:
    """Whether an array has been made there."""
    return (path / _METADATA).exists()


class FrameArray:
    """One such array of values (frame, ...)."""

    def __init__(self, path: Path) -> None:
        """Open an array; `InputError` when it is none, or not one of these."""
        try:
            self._metadata = json.loads((path / _METADATA).read_text())
            self.length, *shape = (int(count) for count in self._metadata["shape"])
            self._type = np.dtype(self._metadata["data_type"]).newbyteorder("<")
            self._separator = str(self._metadata["chunk_key_encoding"]["configuration"]["separator"])
            is_ours = self._metadata["codecs"] == _CODECS
            is_ours &= self._metadata["chunk_grid"]["configuration"]["chunk_shape"] == [1, *shape]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise InputError(f"{path}: is no array of a recording: {error}") from error
        if not is_ours:
            raise InputError(f"{path}: is an array of another kind than a recording's: one plain chunk a frame")
        self.shape = tuple(shape)
        self._path = path
        self._last = self._separator.join("0" * len(shape))

    @classmethod
    def create(
        cls, store: Path, name: str, values: NDArray[Any], dimensions: tuple[str, ...], separator: Separator
    ) -> Self:
        """Make an array for values like these, with the names of their dimensions; the first is `t`, the frame.

        With the separator "/", which OME-NGFF wants for images, each frame lies in a folder of its own; with "." all
        lie in one.
        """
        zarr.open_group(store, mode="a").create_array(
            name,
            shape=(_STEP, *values.shape),
            chunks=(1, *values.shape),
            dtype=values.dtype.name,
            compressors=None,
            filters=None,
            fill_value=math.nan if values.dtype.kind == "f" else 0,
            chunk_key_encoding={"name": "default", "separator": separator},
            dimension_names=("t", *dimensions),
        )
        made = cls(store / name)
        if separator == "/":
            (store / name / "c").mkdir()
        return made

    def write(self, index: int, values: NDArray[Any]) -> int:
        """Write the values of one frame, growing if need be; return how many bytes that were."""
        if values.shape != self.shape:
            raise RunError(f"the size has changed from {_size(self.shape)} to {_size(values.shape)}")
        if index >= self.length:
            self.set_length((index // _STEP + 1) * _STEP)
        if self._separator == "/":
            folder = f"{self._path}/c/{index}"
            for _ in self.shape:
                os.mkdir(folder)  # noqa: PTH102 - pathlib's takes longer
                folder += "/0"
        file = os.open(self._chunk(index), _WRITE, 0o666)
        try:
            left = memoryview(np.ascontiguousarray(values, self._type).data).cast("B")
            while left:
                left = left[os.write(file, left) :]
        finally:
            os.close(file)
        return self._bytes

    def read(self, index: int) -> NDArray[Any] | None:
        """The values of one frame; None where there are none, `InputError` when they are damaged."""
        chunk = self._chunk(index)
        try:
            values = np.fromfile(chunk, self._type)
            size = chunk.stat().st_size
        except FileNotFoundError:
            return None
        except OSError as error:
            raise InputError(f"{chunk}: cannot be read: {error.strerror or error}") from error
        if size != self._bytes:
            raise InputError(f"{chunk}: is damaged: {size} bytes instead of {self._bytes}")
        return values.reshape(self.shape).astype(self._type.newbyteorder("="), copy=False)

    def is_whole(self, index: int) -> bool:
        """Whether the values of a frame are there, all of them."""
        try:
            return self._chunk(index).stat().st_size == self._bytes
        except OSError:
            return False

    def set_length(self, length: int) -> None:
        """Make it longer or shorter for whoever opens the store; the chunks stay."""
        self._metadata["shape"][0] = length
        with atomic_write(self._path / _METADATA) as temporary:
            temporary.write_text(json.dumps(self._metadata, indent=2))
        self.length = length

    def remove(self, index: int) -> None:
        """Remove what has been written of a frame."""
        self._chunk(index).unlink(missing_ok=True)

    @property
    def _bytes(self) -> int:
        return math.prod(self.shape) * int(self._type.itemsize)

    def _chunk(self, index: int) -> Path:
        return self._path / self._separator.join(("c", str(index), self._last))


def _size(shape: tuple[int, ...]) -> str:
    return " x ".join(str(length) for length in shape)
