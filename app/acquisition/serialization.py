"""Messages between processes: JSON text with the layout of arrays, and these arrays as little-endian bytes.

Our own data is never pickled: only plain data of this project's packages can arrive, and to make it runs nothing but
its constructor.
"""

import json
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from app.errors import RunError

_PACKAGES = ("app.", "drivers.", "reconstruction.", "simulated_devices.")
_ALIGNED_BYTES = 64
_HEAD_BYTES = 64  # before the text: its length

Labelled: TypeAlias = tuple[str, tuple[str, ...], str, NDArray[Any]]
"""Name, dimensions and units, as in NetCDF results, and values of an array."""


class Message:
    """A header with labelled arrays, for any program; or with a value of our own."""

    def __init__(self, header: Mapping[str, Any], labelled: Iterable[Labelled] = (), more: str = "") -> None:
        """The entry `value` of the header is a value of our own; `more` is the JSON object of further entries."""
        self._layout, self._arrays = list[dict[str, Any]](), list[NDArray[Any]]()
        for name, dimensions, units, values in labelled:
            self._add(values, name=name, dimensions=dimensions, units=units)
        entries = {key: self._plain(entry) if key == "value" else entry for key, entry in header.items()}
        text = json.dumps(entries | {"arrays": self._layout}, separators=(",", ":"), allow_nan="value" in header)
        self._text = (f"{text[:-1]},{more[1:]}" if more else text).encode()
        self._base = _aligned(_HEAD_BYTES + len(self._text))
        self.nbytes = self._base + sum(_aligned(each.nbytes) for each in self._arrays)

    def _add(self, values: NDArray[Any], **labels: Any) -> int:
        """Add an array, and return its index."""
        values = np.asarray(values, values.dtype.newbyteorder("<"), order="C")
        self._layout.append(labels | {"dtype": values.dtype.str, "shape": values.shape})
        self._arrays.append(values)
        return len(self._arrays) - 1

    def _plain(self, value: Any) -> Any:
        if isinstance(value, np.generic):
            value = value.item()
        if value is None or type(value) in {bool, int, float, str}:
            return value
        kind, content = self._tagged(value)
        return {kind: content}

    def _tagged(self, value: Any) -> tuple[str, Any]:
        """Return a value's kind and its plain content; see `_MAKERS`."""
        if isinstance(value, np.ndarray):
            return "array", self._add(value)
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
        if isinstance(value, tuple) and type(value).__module__.startswith(_PACKAGES):  # a named one
            return [self._plain(each) for each in value]
        if not is_dataclass(value):
            raise RunError(f"a {type(value).__name__} cannot be sent to another process")
        return {each.name: self._plain(getattr(value, each.name)) for each in fields(value)}

    @property
    def parts(self) -> list[bytes]:
        """The text, and the bytes of each array."""
        return [self._text, *(each.tobytes() for each in self._arrays)]

    def write(self, buffer: memoryview) -> None:
        """Copy everything to the beginning of a buffer of at least `nbytes`."""
        buffer[:8] = len(self._text).to_bytes(8, "little")
        buffer[_HEAD_BYTES : _HEAD_BYTES + len(self._text)] = self._text
        offset = self._base
        for array in self._arrays:
            np.ndarray(array.shape, array.dtype, buffer, offset)[...] = array
            offset += _aligned(array.nbytes)

    def message(self) -> bytearray:
        """The same in bytes of its own."""
        made = bytearray(self.nbytes)
        self.write(memoryview(made))
        return made


def encoded(value: object) -> Message:
    """Return a message that holds a value of our own; `RunError` if it is no plain data."""
    return Message({"value": value})


def unpacked(buffer: bytes | bytearray | memoryview) -> Any:
    """Return the value in a message, with arrays as read-only views."""
    return unpacked_frame(buffer)[0]


def unpacked_frame(buffer: bytes | bytearray | memoryview) -> tuple[Any, dict[str, NDArray[Any]]]:
    """Return the value in a message, and the labelled arrays by name.

    Raises
    ------
    RunError
        If it is no such message: cut short, or of another version of this program.
    """
    view = memoryview(buffer).toreadonly()
    try:
        length = int.from_bytes(view[:8], "little")
        header = json.loads(bytes(view[_HEAD_BYTES : _HEAD_BYTES + length]))
        offset, arrays, named = _aligned(_HEAD_BYTES + length), list[NDArray[Any]](), dict[str, NDArray[Any]]()
        for each in header["arrays"]:
            nbytes = np.dtype(each["dtype"]).itemsize * math.prod(each["shape"])
            arrays.append(np.frombuffer(view[offset : offset + nbytes], each["dtype"]).reshape(each["shape"]))
            offset += _aligned(nbytes)
            if "name" in each:
                named[each["name"]] = arrays[-1]
        return _value(header["value"], arrays), named
    except Exception as error:
        raise RunError(f"a message of another process cannot be read, maybe of another version: {error}") from error


def _value(plain: Any, arrays: list[NDArray[Any]]) -> Any:
    if not isinstance(plain, dict):
        return plain
    ((kind, content),) = plain.items()
    return _MAKERS[kind](content, arrays)


_MAKERS: dict[str, Callable[[Any, list[NDArray[Any]]], Any]] = {
    "array": lambda index, arrays: arrays[index],
    "path": lambda text, _: Path(text),
    "mapping": lambda items, arrays: {_value(key, arrays): _value(value, arrays) for key, value in items},
    "tuple": lambda items, arrays: tuple(_value(each, arrays) for each in items),
    "list": lambda items, arrays: [_value(each, arrays) for each in items],
    "of": lambda content, arrays: _record(content[0], content[1], arrays),
}


def _record(name: str, content: Any, arrays: list[NDArray[Any]]) -> Any:
    kind = _kind(name)
    if issubclass(kind, Enum | Exception):
        return kind(content)
    if issubclass(kind, tuple):
        return kind(*(_value(each, arrays) for each in content))
    return kind(**{name: _value(value, arrays) for name, value in content.items()})


@cache
def _kind(name: str) -> type:
    """A record type, enum or error of this project, by module and name; else `ValueError`."""
    module, _, path = name.partition(":")
    if not module.startswith(_PACKAGES):
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
