"""Requests of clients, checked against the methods of the acquisition."""

import inspect
from collections.abc import Callable, Iterable
from concurrent.futures import Future
from dataclasses import fields, is_dataclass
from itertools import zip_longest
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from app.acquisition.commands import Commands
from app.acquisition.remote.messages import Command
from app.acquisition.worker import Acquisition
from drivers.errors import BadValue


def begin_request(command: Command, acquisition: Acquisition) -> Future[Any]:
    """Call the method that a command names, and return its future.

    `BadValue` if that is no command or request of an acquisition, or the arguments do not fit its annotations.
    """
    name = command.request
    method: Any = getattr(Acquisition, name, None)
    hints = get_type_hints(method) if inspect.isfunction(method) and not name.startswith("_") else {}
    if name not in vars(Commands) and get_origin(hints.get("return")) is not Future:
        raise BadValue(f"the instrument knows no command {name}")
    send: Callable[..., Future[Any]] = getattr(acquisition, name)
    try:
        bound = inspect.signature(method).bind(acquisition, *command.arguments, **command.named)
    except TypeError as error:
        raise BadValue(f"{name}: {error}") from error
    for key, value in bound.arguments.items():
        if key in hints and not _fits(value, hints[key]):
            raise BadValue(f"{name}: {key} must be {getattr(hints[key], '__name__', hints[key])}, not {value!r:.60}")
    return send(*command.arguments, **command.named)


def _fits(value: Any, kind: Any) -> bool:
    """True if a value, and what is in it, has an annotated type; of containers only the type is checked."""
    origin, inner = get_origin(kind), get_args(kind)
    if kind is Any:
        return True
    if origin in {Union, UnionType}:
        return any(_fits(value, each) for each in inner)
    if kind in {int, float}:
        return isinstance(value, int | kind) and not isinstance(value, bool)
    if origin is Literal or not isinstance(value, origin or kind):
        return value in inner
    parts: Iterable[tuple[Any, Any]] = ()
    if is_dataclass(kind):
        hints = get_type_hints(kind)
        parts = ((getattr(value, each.name), hints[each.name]) for each in fields(kind))
    elif origin is Iterable:
        parts = ((each, inner[0]) for each in value)
    elif origin is tuple and ... not in inner:
        parts = zip_longest(value, inner)
    return all(_fits(*part) for part in parts)
