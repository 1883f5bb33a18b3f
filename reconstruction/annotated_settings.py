"""Limits, help and units of settings, and their check.

A settings class is a frozen dataclass. `Annotated` gives a field its limit (`annotated_types`) and its help (`Doc`);
its unit is the suffix of its name. A method `faults` yields each setting that contradicts others, and why. The check,
the reader of bench files, the form in the window and the documentation all read these descriptions.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import MISSING, asdict, dataclass, fields, is_dataclass
from functools import cache
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

from annotated_types import BaseMetadata, GroupedMetadata, Interval
from typing_extensions import Doc


@dataclass(frozen=True, slots=True, kw_only=True)
class Limit:
    """The allowed values of a setting; every number of a tuple obeys the bounds."""

    choices: tuple[Any, ...] = ()
    min_length: int = 0  # of a text
    gt: float | None = None
    ge: float | None = None
    le: float | None = None
    is_whole: bool = False
    note: str = ""  # when it holds

    def allows(self, value: Any) -> bool:
        """True if a value of the setting's type is allowed."""
        if self.choices:
            return value in self.choices
        if isinstance(value, str):
            return len(value) >= self.min_length
        return all(
            (self.gt is None or number > self.gt)
            and (self.ge is None or number >= self.ge)
            and (self.le is None or number <= self.le)
            and -math.inf < number < math.inf
            for number in (value if isinstance(value, tuple) else (value,))
        )

    def words(self, unit: str = "", factor: float = 1.0) -> str:
        """Say what a value must be; `factor` is the SI value of the unit."""
        if self.choices:
            return "must be one of " + ", ".join(f'"{choice}"' for choice in self.choices)
        if self.min_length:
            return "must not be empty"
        gt, ge, le = (
            bound if bound is None else str(bound) if self.is_whole else _short(bound / factor)
            for bound in (self.gt, self.ge, self.le)
        )
        bounds = {"above": gt, "at least": ge, "at most": le}
        allowed = " and ".join(f"{relation} {bound}" for relation, bound in bounds.items() if bound is not None)
        if ge is not None and le is not None:
            allowed = f"{ge} or {le}" if self.is_whole and self.le == (self.ge or 0) + 1 else f"{ge} ... {le}"
        plain = {"above 0": "positive", "at least 0": "0 or positive", "": "finite"}.get(allowed)
        return " ".join(filter(None, ("must be", plain or allowed, "" if plain else unit, self.note)))


@dataclass(frozen=True, slots=True)
class Depending:
    """A limit that follows from other settings."""

    limit: Callable[[Any], Interval]  # called with an object that has all settings
    note: str


class OwnNames:
    """Word of an annotation: Python may give a name that is none of the choices, that of an own method."""


class SettingError(ValueError):
    """A setting has a value that it cannot have."""

    def __init__(self, path: str, why: str, limit: Limit | None = None) -> None:
        """`path` has a dot before the setting of a part; `limit` is the one that is broken, if `why` says it."""
        super().__init__(path, why, limit)
        self.path, self.why, self.limit = path, why, limit

    def __str__(self) -> str:
        return f"{self.path} {self.why}"


@dataclass(frozen=True, slots=True)
class Setting:
    """One field of a settings class."""

    name: str
    kind: Any  # its type, without None
    is_optional: bool  # may be None
    default: Any  # MISSING if it must be given
    help: str
    section: str  # of a bench file, if the setting stands in another than its class
    _limit: Limit | Depending | None

    def limit(self, settings: Any) -> Limit | None:
        """Return the limit beside these other settings."""
        if isinstance(self._limit, Depending):
            return _limit(self.kind, [self._limit.limit(settings)], self._limit.note)
        return self._limit


@cache
def settings_of(cls: type) -> tuple[Setting, ...]:
    """Return the description of every field of a settings class."""
    hints = get_type_hints(cls, include_extras=True)
    described = []
    for field in fields(cls):
        kind, outer = _parts(hints[field.name])
        is_optional = type(None) in get_args(kind)
        if is_optional:
            kind = next(part for part in get_args(kind) if part is not type(None))
        kind, inner = _parts(kind)
        words = outer + inner
        default = field.default if field.default_factory is MISSING else field.default_factory()
        text = next((word.documentation for word in words if isinstance(word, Doc)), "")
        limit = next((word for word in words if isinstance(word, Depending)), None) or _limit(kind, words)
        section = field.metadata.get("section", "")
        described.append(Setting(field.name, kind, is_optional, default, text, section, limit))
    return tuple(described)


def _parts(hint: Any) -> tuple[Any, tuple[Any, ...]]:
    """Split an annotation into its type and its words."""
    return (hint.__origin__, hint.__metadata__) if get_origin(hint) is Annotated else (hint, ())


def _limit(kind: Any, words: Iterable[object], note: str = "") -> Limit | None:
    """Return the limit of a type with the words of its annotation."""
    if get_origin(kind) is Literal:
        return None if any(isinstance(word, OwnNames) for word in words) else Limit(choices=get_args(kind))
    parts = [part for word in words for part in (word if isinstance(word, GroupedMetadata) else (word,))]
    bounds: dict[str, Any] = {}
    for part in parts:
        if isinstance(part, BaseMetadata) and is_dataclass(part):
            bounds |= asdict(part)
    return Limit(**bounds, is_whole=kind is int, note=note) if bounds or kind is float else None


def check(settings: object) -> None:
    """Raise `SettingError` if a setting, or one of a part, has a value that it cannot have."""
    cls: type = type(settings)
    for setting in settings_of(cls):
        value, limit = getattr(settings, setting.name), setting.limit(settings)
        if limit is not None:
            if value is not None and not limit.allows(value):
                raise SettingError(setting.name, limit.words(), limit)
        elif is_dataclass(value):
            try:
                check(value)
            except SettingError as error:
                raise SettingError(f"{setting.name}.{error.path}", error.why, error.limit) from None
    for path, why in getattr(settings, "faults", tuple)():
        raise SettingError(path, why)


class Checked:
    """Base of settings classes whose objects check themselves when they are made."""

    __slots__ = ()

    def __post_init__(self) -> None:
        check(self)


def _short(number: float) -> str:
    """Write a number without needless zeros: 1e-7, not 1e-07."""
    digits, _, exponent = f"{number:g}".partition("e")
    return f"{digits}e{int(exponent)}" if exponent else digits
