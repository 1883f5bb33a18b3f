"""Settings classes: what their annotations say, and the check of settings that contradict each other.

A settings class is a frozen dataclass. `Annotated` gives a field its limit (`annotated_types`) and its help (`Doc`);
its unit is the suffix of its name. A method `faults` yields each setting that contradicts others, and why. A bench
checks types and limits of all its settings; reader, JSON schema, form and documentation have the same descriptions.
"""

from collections.abc import Iterator
from dataclasses import fields
from typing import Any, get_args, get_type_hints

from typing_extensions import Doc


class SettingError(ValueError):
    """A setting has a value that it cannot have."""

    def __init__(self, path: str, why: str, limit: dict[str, Any] | None = None) -> None:
        """`path` has a dot before the setting of a part; `limit`, a JSON schema, is the broken one if `why` says it."""
        super().__init__(path, why, limit)
        self.path, self.why, self.limit = path, why, limit

    def __str__(self) -> str:
        return f"{self.path} {self.why}"


def check(settings: Any) -> None:
    """Raise `SettingError` if settings contradict each other, also in a part."""
    for field in fields(settings):
        part = getattr(settings, field.name)
        if hasattr(part, "faults"):
            try:
                check(part)
            except SettingError as error:
                raise SettingError(f"{field.name}.{error.path}", error.why) from None
    for path, why in getattr(settings, "faults", tuple)():
        raise SettingError(path, why)


class Checked:
    """Base of settings classes that refuse contradictions when they are made."""

    __slots__ = ()

    def __post_init__(self) -> None:
        check(self)


def help_of(cls: type) -> dict[str, str]:
    """Return the help of every setting, empty if it has none."""
    hints = get_type_hints(cls, include_extras=True)
    return {
        name: next((word.documentation for word in _words(hint) if isinstance(word, Doc)), "")
        for name, hint in hints.items()
    }


def _words(hint: Any) -> Iterator[Any]:
    """Yield the types and words in an annotation."""
    parts = get_args(hint)
    yield from (word for part in parts for word in _words(part)) if parts else (hint,)
