"""Conversion of what a TOML file holds into settings, and of its faults into sentences."""

import dataclasses
import math
from collections.abc import Callable
from functools import cache
from typing import Any, Literal, TypeVar, get_args, get_origin

import cattrs

from app.bench.device_settings import CameraSettings, LightSettings, drivers_of

T = TypeVar("T")

UNKNOWN = "unknown key"  # begins a sentence


@cache
def converter() -> cattrs.Converter:
    """Converter without implicit conversions: no text for a number, no true for 1, no NaN."""
    made = cattrs.Converter(forbid_extra_keys=True)
    made.register_structure_hook(int, _exactly(int, "a whole number"))
    made.register_structure_hook(bool, _exactly(bool, "true or false"))
    made.register_structure_hook(str, _exactly(str, "text in quotes"))
    made.register_structure_hook(float, lambda value, _: _number(value))
    made.register_structure_hook_func(
        lambda kind: kind in (CameraSettings, LightSettings), lambda value, kind: _by_driver(made, value, kind)
    )
    return made


def _by_driver(made: cattrs.Converter, value: Any, kind: Any) -> Any:
    """Read a section into the settings class of its driver, by default the simulated one."""
    if not isinstance(value, dict):
        raise ValueError("must be a section")  # noqa: TRY004 - cattrs handles it like other values
    known, driver = drivers_of(kind), value.get("driver", "simulated")
    if driver not in known:
        raise ValueError(f"driver = {driver!r} is unknown; known are " + ", ".join(f'"{name}"' for name in known))
    return made.structure(value, known[driver])


def _exactly(kind: type[T], what: str) -> Callable[[Any, Any], T]:
    def take(value: Any, _: Any) -> T:
        if type(value) is not kind:
            raise TypeError(f"must be {what}, not {value!r}")
        return value

    return take


def _number(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise TypeError(f"must be a finite number, not {value!r}")
    return float(value)


def sentence_of(error: BaseException, kind: type | None) -> str:
    """Describe an error; cattrs adds the path of the key."""
    if isinstance(error, cattrs.ForbiddenExtraKeysError):
        extra = ", ".join(sorted(error.extra_fields))
        known = ", ".join(field.name for field in dataclasses.fields(error.cl))
        return f"{UNKNOWN} {extra}; known are {known}"
    if isinstance(error, KeyError):
        return "is missing"
    if type(None) in get_args(kind):  # an optional setting
        kind = get_args(kind)[0]
    if get_origin(kind) is Literal:
        return "must be one of " + ", ".join(f'"{value}"' for value in get_args(kind))
    if dataclasses.is_dataclass(kind) and not isinstance(error, ValueError):
        return "must be a section"
    return str(error)
