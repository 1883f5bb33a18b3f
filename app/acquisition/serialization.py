"""Messages between our processes: JSON text with the layout of arrays, and these arrays as little-endian bytes.

Our own data is never pickled: only plain data of this project's packages can arrive, and to make it runs nothing but
its constructor.
"""

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.errors import RunError

_PACKAGES = ("app.", "drivers.", "reconstruction.", "simulated_devices.")
_ALIGNED_BYTES = 64
_HEAD_BYTES = 64  # before the text: its length
MOST_BYTES = 2**28  # of a message to the instrument: a calibration of 2048 x 2048 pixels has a third


class Message:
    """A value with its arrays; `RunError` if it is no plain data."""

    def __init__(self, value: object) -> None:
        self._arrays = list[NDArray[Any]]()
        plain = _plain(value, self._arrays)
        layout = [(each.dtype.str, each.shape) for each in self._arrays]
        self._text = json.dumps((plain, layout), separators=(",", ":")).encode()
        self.nbytes = _aligned(_HEAD_BYTES + len(self._text)) + sum(_aligned(each.nbytes) for each in self._arrays)

    def write(self, buffer: memoryview) -> None:
        """Copy everything to the beginning of a buffer of at least `nbytes`."""
        buffer[:8] = len(self._text).to_bytes(8, "little")
        buffer[_HEAD_BYTES : _HEAD_BYTES + len(self._text)] = self._text
        offset = _aligned(_HEAD_BYTES + len(self._text))
        for array in self._arrays:
            np.ndarray(array.shape, array.dtype, buffer, offset)[...] = array
            offset += _aligned(array.nbytes)


def encoded(value: object) -> bytearray:
    """Return a message in bytes; `RunError` if the value is no plain data."""
    message = Message(value)
    message.write(memoryview(made := bytearray(message.nbytes)))
    return made


def unpacked(buffer: bytes | bytearray | memoryview) -> Any:
    """Return a message's value, its arrays read-only views; `RunError` if it is cut short or of another version."""
    view = memoryview(buffer).toreadonly()
    try:
        length = int.from_bytes(view[:8], "little")
        plain, layout = json.loads(bytes(view[_HEAD_BYTES : _HEAD_BYTES + length]))
        offset, arrays = _aligned(_HEAD_BYTES + length), list[NDArray[Any]]()
        for dtype, shape in layout:
            nbytes = np.dtype(dtype).itemsize * math.prod(shape)
            arrays.append(np.frombuffer(view[offset : offset + nbytes], dtype).reshape(shape))
            offset += _aligned(nbytes)
        return _value(plain, arrays)
    except Exception as error:
        raise RunError(f"a message of another process cannot be read, maybe of another version: {error}") from error


def little_endian(values: NDArray[Any]) -> NDArray[Any]:
    """Return an array as it is sent."""
    return np.asarray(values, values.dtype.newbyteorder("<"), order="C")


def _plain(value: Any, arrays: list[NDArray[Any]]) -> Any:
    """Return a value for JSON, all but the simplest as kind and content; arrays are appended to a list."""
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or type(value) in {bool, int, float, str}:
        return value
    if isinstance(value, np.ndarray):
        arrays.append(little_endian(value))
        return {"array": len(arrays) - 1}
    kind, content = _taken_apart(value)
    return {kind: [_plain(each, arrays) for each in content] if isinstance(content, list) else content}


def _taken_apart(value: Any) -> tuple[str, Any]:
    """Return the kind of a value, and a list of its parts, or a text or number."""
    kind = type(value)
    name, is_own = f"{kind.__module__}:{kind.__qualname__}", kind.__module__.startswith(_PACKAGES)
    if isinstance(value, Path):
        return "path", str(value)
    if isinstance(value, Mapping):
        return "mapping", [part for item in value.items() for part in item]
    if kind in {tuple, list} or (isinstance(value, tuple) and is_own):
        return name if is_own else kind.__name__, list(value)
    if isinstance(value, Enum | Exception):
        return name, value.value if isinstance(value, Enum) else str(value)
    if is_dataclass(value):
        return name, [getattr(value, each.name) for each in fields(value)]
    raise RunError(f"a {kind.__name__} cannot be sent to another process")


def _value(plain: Any, arrays: list[NDArray[Any]]) -> Any:
    if not isinstance(plain, dict):
        return plain
    ((name, content),) = plain.items()
    if name == "array":
        return arrays[content]
    make = _MAKERS.get(name) or _maker(name)
    return make(*(_value(each, arrays) for each in content)) if isinstance(content, list) else make(content)


_MAKERS: dict[str, Callable[..., Any]] = {
    "path": Path,
    "mapping": lambda *parts: dict(zip(parts[::2], parts[1::2], strict=True)),
    "tuple": lambda *parts: parts,
    "list": lambda *parts: list(parts),
}


@cache
def _maker(name: str) -> Callable[..., Any]:
    """Return what makes a record, enum or error of this project, by module and name; else `ValueError`."""
    module, _, path = name.partition(":")
    if not module.startswith(_PACKAGES):
        raise ValueError(f"{name} is no type of this program")
    found: Any = import_module(module)
    for part in path.split("."):
        found = getattr(found, part)
    if isinstance(found, type) and is_dataclass(found):
        names = [each.name for each in fields(found)]
        return lambda *values: found(**dict(zip(names, values, strict=True)))
    is_record = isinstance(found, type) and (
        issubclass(found, Enum | Exception) or (issubclass(found, tuple) and hasattr(found, "_fields"))
    )
    if not is_record:
        raise ValueError(f"{name} holds no plain data")
    return found  # type: ignore[no-any-return] # checked


def _aligned(size: int) -> int:
    return -(-size // _ALIGNED_BYTES) * _ALIGNED_BYTES
