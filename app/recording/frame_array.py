"""A Zarr v3 array that grows frame by frame; each frame is one chunk, and so one file.

The Zarr library makes the store. Chunks hold plain little-endian values and are written and read here: ten times
faster, which leaves the processor to the live path; missing frames are distinguished from zeros; and an array can be
read while it grows, beyond the length in its metadata. A frame takes few system calls, because at each one another
thread may take over for 5 ms.
"""

import json
import math
import os
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import NDArray

from app.errors import InputError, RunError
from app.files import check_readable, in_words, sync, write_whole
from app.recording.folder import PIXELS

METADATA = "zarr.json"  # in the folder of an array or group
HINT = "svwfs recover lists the readable frames"  # of what is damaged
_STEP = 4096  # frames by which an array grows
_WRITE = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | getattr(os, "O_BINARY", 0)
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
            self.length, *shape = (int(count) for count in self._metadata["shape"])
            self._type = np.dtype(self._metadata["data_type"]).newbyteorder("<")
            self._separator = str(self._metadata["chunk_key_encoding"]["configuration"]["separator"])
            is_ours = self._metadata["codecs"] == _CODECS and self._metadata["data_type"] in _TYPES
            is_ours &= self._metadata["chunk_grid"]["configuration"]["chunk_shape"] == [1, *shape]
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            why = f"not an array of a recording: {in_words(error)}"
            raise InputError(f"{path / METADATA}: is damaged: {why}") from error
        if not is_ours:
            raise InputError(
                f"{path}: is damaged: not an array of one plain chunk of {' or '.join(_TYPES)} for each frame"
            )
        self.shape = tuple(shape)
        self._path = path
        self._last = self._separator.join("0" * len(shape))

    @classmethod
    def create(cls, store: Path, name: str, values: NDArray[Any]) -> Self:
        """Make an array for values like these of one frame; its first dimension is `t`, the frame.

        With the separator "/", which OME-NGFF demands for images, each frame has its own folder; with "." all chunks
        lie in one.
        """
        separator: Literal["/", "."] = "/" if name == PIXELS else "."
        import zarr  # noqa: PLC0415 - takes a fifth of a second, and only a new recording needs it

        zarr.open_group(store, mode="a").create_array(
            name,
            shape=(_STEP, *values.shape),
            chunks=(1, *values.shape),
            dtype=values.dtype.name,
            compressors=None,
            filters=None,
            fill_value=math.nan if values.dtype.kind == "f" else 0,
            chunk_key_encoding={"name": "default", "separator": separator},
            dimension_names=("t", *_DIMENSIONS[name.rpartition("/")[2]]),
        )
        made = cls(store / name)
        if separator == "/":
            (store / name / "c").mkdir(exist_ok=True)
        for folder in (store / name, *(store / name).parents):
            if not (folder / METADATA).exists():
                break
            sync(folder / METADATA)
            sync(folder)
        return made

    def write(self, index: int, values: NDArray[Any]) -> int:
        """Write the values of one frame, of `shape`, growing if necessary; return the number of bytes."""
        if values.shape != self.shape:
            raise RunError(f"the size has changed from {_size(self.shape)} to {_size(values.shape)}")
        if index >= self.length:
            self.set_length((index // _STEP + 1) * _STEP)
        if self._separator == "/":
            folder = f"{self._path}/c/{index}"
            for _ in self.shape:
                os.mkdir(folder)  # noqa: PTH102 - pathlib is slower
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
        """The values of one frame, None if they are missing; `DamagedFrame` if they are damaged."""
        chunk = self._chunk(index)
        try:
            size = chunk.stat().st_size
            if size != self._bytes:  # also a pipe, which would have to be waited for
                raise DamagedFrame(f"{chunk}: is damaged: {size} bytes instead of {self._bytes}; {HINT}")
            values = np.fromfile(chunk, self._type)
        except FileNotFoundError:
            return None
        except OSError as error:
            raise DamagedFrame(f"{chunk}: cannot be read: {in_words(error)}; {HINT}") from error
        return values.reshape(self.shape).astype(self._type.newbyteorder("="), copy=False)

    def is_whole(self, index: int) -> bool:
        """True if all values of a frame exist."""
        try:
            return self._chunk(index).stat().st_size == self._bytes
        except OSError:
            return False

    def set_length(self, length: int) -> None:
        """Change the length in the metadata; chunks stay."""
        self._metadata["shape"][0] = length
        write_whole(self._path / METADATA, json.dumps(self._metadata, indent=2))
        self.length = length

    def remove(self, index: int) -> None:
        """Remove the values of a frame."""
        self._chunk(index).unlink(missing_ok=True)

    @property
    def _bytes(self) -> int:
        return math.prod(self.shape) * int(self._type.itemsize)

    def _chunk(self, index: int) -> Path:
        return self._path / self._separator.join(("c", str(index), self._last))


def _size(shape: tuple[int, ...]) -> str:
    return " x ".join(str(length) for length in shape)
