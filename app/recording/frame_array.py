"""A Zarr v3 array that grows frame by frame.

Chunks hold plain little-endian values of some frames, one after the other. The store is written and read without the
Zarr library, whose import takes half a second and whose writing ten times as long: the processor is for the live path.
Missing frames are distinguished from zeros, and an array can be read while it grows, beyond the length in its metadata.
A frame takes few system calls, because at each one another thread may take over.
"""

import json
import math
import os
from collections.abc import Mapping
from io import FileIO
from pathlib import Path
from types import MappingProxyType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from app.errors import InputError, RunError
from app.files import check_readable, in_words, sync, write_whole
from app.recording.folder import PIXELS

METADATA = "zarr.json"  # in the folder of an array or group
HINT = "svwfs recover lists the readable frames"  # of what is damaged
_LENGTH = 1 << 20  # of an unfinished array, frames
_FRAMES_IN_CHUNK, _CHUNK_BYTES = 16, 8 << 20  # at most; a new file takes as long as writing 1 MB
_TYPES = ("uint16", "float32", "float64")  # of pixels and results
_DIMENSIONS = {
    PIXELS: ("y", "x"),
    "displacement": ("lenslet_row", "lenslet_column", "field_mode", "xy"),
    "coefficients": ("pupil_mode", "field_mode"),
}
_CODECS = [{"name": "bytes", "configuration": {"endian": "little"}}]


def is_array(path: Path) -> bool:
    """True if there is an array."""
    return (path / METADATA).is_file()


class DamagedFrame(InputError):
    """A frame of a recording is missing or damaged; the others can be read."""


class FrameArray:
    """An array of values (frame, ...)."""

    def __init__(self, path: Path) -> None:
        """Open an array; `InputError` if it is not one of a recording."""
        check_readable(path / METADATA)
        try:
            self._metadata = json.loads((path / METADATA).read_text("utf-8"))
            _, *shape = map(int, self._metadata["shape"])
            self._in_chunk, *chunk_shape = map(int, self._metadata["chunk_grid"]["configuration"]["chunk_shape"])
            self._type = np.dtype(self._metadata["data_type"]).newbyteorder("<")
            self._separator = str(self._metadata["chunk_key_encoding"]["configuration"]["separator"])
            is_ours = self._metadata["codecs"] == _CODECS and self._metadata["data_type"] in _TYPES
            is_ours &= chunk_shape == shape and self._in_chunk > 0
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            why = f"not an array of a recording: {in_words(error)}"
            raise InputError(f"{path / METADATA}: is damaged: {why}") from error
        if not is_ours:
            raise InputError(f"{path}: is damaged: not an array of plain chunks of whole frames, {' or '.join(_TYPES)}")
        self.shape = tuple(shape)
        self._path = path
        self._last = self._separator.join("0" * len(shape))
        self._bytes = math.prod(shape) * int(self._type.itemsize)  # of a frame
        self._file: FileIO | None = None  # the open chunk
        self._number = self._frames = 0  # its number, and the frames in it

    @classmethod
    def create(cls, store: Path, name: str, values: NDArray[Any]) -> Self:
        """Make an array (t, ...) of values like these of one frame; separator "/": a folder per chunk (OME-NGFF)."""
        group, separator = store, "/" if name == PIXELS else "."
        in_chunk = max(1, min(_FRAMES_IN_CHUNK, _CHUNK_BYTES // max(values.nbytes, 1)))
        for part in Path(name).parent.parts:
            group /= part
            if not (group / METADATA).exists():
                make_group(group)
        _write_metadata(
            store / name,
            {
                "shape": [_LENGTH, *values.shape],
                "data_type": values.dtype.name,
                "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": [in_chunk, *values.shape]}},
                "chunk_key_encoding": {"name": "default", "configuration": {"separator": separator}},
                "fill_value": "NaN" if values.dtype.kind == "f" else 0,
                "codecs": _CODECS,
                "attributes": {},
                "dimension_names": ["t", *_DIMENSIONS[name.rpartition("/")[2]]],
                "zarr_format": 3,
                "node_type": "array",
                "storage_transformers": [],
            },
        )
        return cls(store / name)

    def write(self, index: int, values: NDArray[Any]) -> None:
        """Write the values of one frame, of `shape`."""
        if values.shape != self.shape:
            raise RunError(f"the size has changed from {_size(self.shape)} to {_size(values.shape)}")
        number, place = divmod(index, self._in_chunk)
        if self._file is None or number != self._number:
            self._open(number)
        if place > self._frames:
            self._append(self._missing(place - self._frames))
        self._append(values)
        self._frames = place + 1
        if self._frames == self._in_chunk:
            self.close()

    def close(self) -> None:
        """Close the open chunk, if any."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def read(self, index: int) -> NDArray[Any] | None:
        """The values of one frame, None if they are missing; `DamagedFrame` if they are damaged."""
        number, place = divmod(index, self._in_chunk)
        chunk, begin = self._chunk(number), place * self._bytes
        try:
            size = chunk.stat().st_size
            if place and size <= begin:
                return None
            if not self.is_whole(index):  # also a pipe, which would have to be waited for
                raise DamagedFrame(f"{chunk}: is damaged: {size} bytes instead of {begin + self._bytes}; {HINT}")
            values = np.fromfile(chunk, self._type, math.prod(self.shape), offset=begin)
        except FileNotFoundError:
            return None
        except OSError as error:
            raise DamagedFrame(f"{chunk}: cannot be read: {in_words(error)}; {HINT}") from error
        if self._in_chunk > 1 and self._type.kind == "f" and np.isnan(values).all():
            return None
        return values.reshape(self.shape).astype(self._type.newbyteorder("="), copy=False)

    def is_whole(self, index: int) -> bool:
        """True if all values of a frame exist."""
        number, place = divmod(index, self._in_chunk)
        try:
            size = self._chunk(number).stat().st_size
        except OSError:
            return False
        return (place + 1) * self._bytes <= size <= self._in_chunk * self._bytes

    def finish(self, length: int) -> None:
        """Set the length and fill up the chunks: with missing frames up to the length, beyond it with zeros."""
        self.close()
        self._metadata["shape"][0] = length
        _write_metadata(self._path, self._metadata)
        for number in range(-(-length // self._in_chunk) if self._in_chunk > 1 else 0):
            chunk, whole = self._chunk(number), self._in_chunk * self._bytes
            if chunk.exists() and chunk.stat().st_size < whole:
                with self._open(number) as file:
                    self._append(self._missing(min(self._in_chunk, length - number * self._in_chunk) - self._frames))
                    file.truncate(whole)  # takes no space on a full disk

    def remove(self, index: int) -> None:
        """Remove the values of a frame, and of later ones in its chunk."""
        self.close()
        number, place = divmod(index, self._in_chunk)
        if not place:
            self._chunk(number).unlink(missing_ok=True)
        elif self.is_whole(index - 1):
            os.truncate(self._chunk(number), place * self._bytes)

    def _missing(self, frames: int) -> NDArray[Any]:
        return np.full((max(frames, 0), *self.shape), np.nan if self._type.kind == "f" else 0, self._type)

    def _open(self, number: int) -> FileIO:
        """Open a chunk to append to its whole frames."""
        self.close()
        chunk = self._chunk(number)
        chunk.parent.mkdir(parents=True, exist_ok=True)
        self._file, self._number = FileIO(chunk, "a"), number
        self._frames = self._file.tell() // self._bytes
        self._file.truncate(self._frames * self._bytes)
        return self._file

    def _append(self, values: NDArray[Any]) -> None:
        append(self._file, np.ascontiguousarray(values, self._type).reshape(-1).data)

    def _chunk(self, number: int) -> Path:
        return Path(f"{self._path}/c{self._separator}{number}{self._separator}{self._last}")


def append(file: Any, data: Any) -> None:
    """Append all bytes to an unbuffered file, which may take some at a time."""
    left = memoryview(data).cast("B")
    while left:
        left = left[file.write(left) :]


def make_group(path: Path, attributes: Mapping[str, Any] = MappingProxyType({})) -> None:
    """Make a Zarr group."""
    _write_metadata(path, {"attributes": dict(attributes), "zarr_format": 3, "node_type": "group"})


def _write_metadata(folder: Path, metadata: Mapping[str, Any]) -> None:
    """Write a folder's metadata; they and the folder's name are on the disk afterwards."""
    write_whole(folder / METADATA, json.dumps(metadata, indent=2))
    sync(folder.parent)


def _size(shape: tuple[int, ...]) -> str:
    return " x ".join(str(length) for length in shape)
