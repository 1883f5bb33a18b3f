"""Requests of clients, checked against the methods of the acquisition."""

import inspect
from concurrent.futures import Future
from typing import Any, get_origin, get_type_hints

from app.acquisition.commands import Commands
from app.acquisition.remote.messages import Command
from app.acquisition.worker import Acquisition
from app.bench.settings_schema import fits
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
    try:
        bound = inspect.signature(method).bind(acquisition, *command.arguments, **command.named)
    except TypeError as error:
        raise BadValue(f"{name}: {error}") from error
    for key in bound.arguments.keys() & hints:
        if not fits(value := bound.arguments[key], hints[key]):
            kind = getattr(hints[key], "__name__", hints[key])
            raise BadValue(f"{name}: {key} must be {kind}, not {value!r:.60}")
    future: Future[Any] = method(*bound.args, **bound.kwargs)
    return future
