"""Our own data between processes: JSON text, and arrays behind it.

Never pickle: only types of this project's rooms can arrive, and to make one runs nothing but its constructor. Large
objects that belong to many frames travel once; where they occur, a message has their number instead.
"""

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from app.errors import RunError
from reconstruction.runtime.deferred import Deferred

_ROOMS = ("app.", "drivers.", "reconstruction.", "simulated_devices.")
_ALIGNED_BYTES = 64
_HEAD_BYTES = 64  # before the text: its length

Numbered: TypeAlias = Callable[[Any], int | None]
"""The number of an object that travels by itself; None for what is written where it occurs."""


class Absent(Exception):
    """An object that a message refers to has not arrived."""


class Encoded:
    """A value ready to be written: its text, and its arrays at their places behind it."""

    def __init__(self, value: object, numbered: Numbered = lambda _: None) -> None:
        self._numbered, self._arrays, self._end = numbered, list[tuple[int, NDArray[Any]]](), 0
        self._text = json.dumps(self._plain(value), separators=(",", ":")).encode()
        self._base = _aligned(_HEAD_BYTES + len(self._text))
        self.nbytes = self._base + self._end

    def write(self, buffer: memoryview) -> None:
        """Copy everything to the beginning of a buffer of at least `nbytes`."""
        buffer[:8] = len(self._text).to_bytes(8, "little")
        buffer[_HEAD_BYTES : _HEAD_BYTES + len(self._text)] = self._text
        for offset, array in self._arrays:
            np.ndarray(array.shape, array.dtype, buffer, self._base + offset)[...] = array

    def message(self) -> bytearray:
        """The same in bytes of its own."""
        made = bytearray(self.nbytes)
        self.write(memoryview(made))
        return made

    def _plain(self, value: Any) -> Any:
        if isinstance(value, np.generic):
            value = value.item()
        if value is None or type(value) in {bool, int, float, str}:
            return value
        number = self._numbered(value)
        kind, content = ("number", number) if number is not None else self._tagged(value)
        return {kind: content}

    def _tagged(self, value: Any) -> tuple[str, Any]:
        """A value's kind and its plain content; see `_Reader`."""
        if isinstance(value, np.ndarray):
            return "array", [value.dtype.str, value.shape, self._offset(value)]
        if isinstance(value, Path):
            return "path", str(value)
        if isinstance(value, Mapping):
            return "mapping", [[self._plain(key), self._plain(each)] for key, each in value.items()]
        if type(value) in {tuple, list}:
            return type(value).__name__, [self._plain(each) for each in value]
        return "of", [f"{type(value).__module__}:{type(value).__qualname__}", self._content(value)]

    def _content(self, value: Any) -> Any:
        if isinstance(value, Enum):
            return value.value
        if isinstance(value, Exception):
            return str(value)
        if isinstance(value, tuple):  # a named one
            return [self._plain(each) for each in value]
        if not is_dataclass(value):
            raise TypeError(f"a {type(value).__name__} cannot be sent to another process")
        # A deferred value is computed first; the source of a covariance is plain data and travels as it is.
        contents = {each.name: getattr(value, each.name) for each in fields(value)}
        return {name: self._plain(each() if isinstance(each, Deferred) else each) for name, each in contents.items()}

    def _offset(self, array: NDArray[Any]) -> int:
        offset, self._end = self._end, _aligned(self._end + array.nbytes)
        self._arrays.append((offset, array))
        return offset


def _unknown(number: int) -> Any:
    raise ValueError(f"object {number} is unknown")


def unpacked(buffer: bytes | bytearray | memoryview, find: Callable[[int], Any] = _unknown) -> Any:
    """Read what `Encoded` wrote, with arrays as read-only views; `find` returns an object by number.

    Raises
    ------
    RunError
        If it is no such message: cut short, or of another version of this program.
    """
    view = memoryview(buffer).toreadonly()
    try:
        length = int.from_bytes(view[:8], "little")
        base = _aligned(_HEAD_BYTES + length)
        return _Reader(view[base:], find)(json.loads(bytes(view[_HEAD_BYTES : _HEAD_BYTES + length])))
    except Absent:
        raise
    except Exception as error:
        raise RunError(f"a message of another process cannot be read, maybe of another version: {error}") from error


class _Reader:
    """Makes values from their plain form and the arrays behind it."""

    def __init__(self, arrays: memoryview, find: Callable[[int], Any]) -> None:
        self._arrays = arrays
        self._makers: dict[str, Callable[[Any], Any]] = {
            "number": find,
            "array": self._array,
            "path": Path,
            "mapping": lambda items: {self(key): self(value) for key, value in items},
            "tuple": lambda items: tuple(map(self, items)),
            "list": lambda items: list(map(self, items)),
            "of": self._record,
        }

    def __call__(self, plain: Any) -> Any:
        if not isinstance(plain, dict):
            return plain
        ((kind, content),) = plain.items()
        return self._makers[kind](content)

    def _array(self, content: Any) -> NDArray[Any]:
        dtype, shape, offset = content
        nbytes = np.dtype(dtype).itemsize * math.prod(shape)
        return np.frombuffer(self._arrays[offset : offset + nbytes], dtype).reshape(shape)

    def _record(self, content: Any) -> Any:
        kind = _kind(content[0])
        if issubclass(kind, Enum | Exception):
            return kind(content[1])
        if issubclass(kind, tuple):
            return kind(*map(self, content[1]))
        return kind(**{name: self(value) for name, value in content[1].items()})


@cache
def _kind(name: str) -> type:
    """A record type, enum or error of this project, by module and name; else `ValueError`."""
    module, _, path = name.partition(":")
    if not module.startswith(_ROOMS):
        raise ValueError(f"{name} is no type of this program")
    found: Any = import_module(module)
    for part in path.split("."):
        found = getattr(found, part)
    is_record = isinstance(found, type) and (
        is_dataclass(found)
        or issubclass(found, Enum | Exception)
        or (issubclass(found, tuple) and hasattr(found, "_fields"))
    )
    if not is_record:
        raise ValueError(f"{name} holds no plain data")
    return found  # type: ignore[no-any-return] # checked


def _aligned(size: int) -> int:
    return -(-size // _ALIGNED_BYTES) * _ALIGNED_BYTES
