"""Strict reader of settings classes and their JSON schema, both made by pydantic from the annotations.

Pydantic loads when the first settings are read. Its errors become one sentence with key and limit.
"""

import difflib
import inspect
import json
from collections.abc import Collection
from dataclasses import is_dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, get_args, get_type_hints

from reconstruction.annotated_settings import SettingError, help_of

if TYPE_CHECKING:
    from pydantic import TypeAdapter
    from pydantic_core import ErrorDetails

Schema = dict[str, Any]  # a JSON schema; everything is in its place, there are no references

_UNIT_OF_ENDS = {  # by the end of a name; the first that fits
    "_m_per_s": "m/s",
    "_e_per_s": "electrons/s",
    "_nm": "nm",
    "_m": "m",
    "_s": "s",
    "_a": "A",
    "_px": "px",
    "_rad": "rad",
    "_hz": "Hz",
    "_e": "electrons",
    "_counts": "counts",
}
_TYPES = {
    "integer": "a whole number",
    "boolean": "true or false",
    "string": "text in quotes",
    "number": "a finite number",
    "object": "a section",
    "array": "a list",
}
_UNKNOWN = "unexpected_keyword_argument"
_LIMITS = ("literal_error", "greater_than", "less_than", "string_too_short")  # beginnings of pydantic's words
_NULL_CHARACTER = ["\0"]  # in place of a text with one: no name of a file or a device has it
_MOST = 10**300  # larger integers are no better


def read_section(cls: Any, values: object, path: str) -> Any:
    """Read a section as TOML has it, whole numbers also as floats; `SettingError` has the first wrong key's path."""
    from pydantic import ValidationError

    try:
        return _reader(cls).validate_json(json.dumps([_plain(values)]))[0]
    except ValidationError as error:
        errors = error.errors(include_url=False)
        raise _fault(min(errors, key=lambda each: each["type"] != _UNKNOWN), path, section_schema(cls)) from None


@cache
def _reader(cls: Any) -> "TypeAdapter[tuple[Any]]":
    """Return pydantic's reader of one section, in a list because a class has a configuration of its own."""
    from pydantic import TypeAdapter

    return TypeAdapter(tuple[cls], config={"strict": True, "extra": "forbid", "allow_inf_nan": False})


def fits(value: object, kind: Any) -> bool:
    """Return whether a value, and what it holds, has an annotated type."""
    from pydantic import ValidationError

    try:
        _checker(kind).validate_python((value,))
    except ValidationError:
        return False
    return True


@cache
def _checker(kind: Any) -> "TypeAdapter[tuple[Any]]":
    from pydantic import TypeAdapter

    checks: Any = {"strict": True, "revalidate_instances": "always", "arbitrary_types_allowed": True}
    return TypeAdapter(tuple[kind], config=checks)


def _plain(value: Any) -> Any:
    """Return a value of TOML or Python as JSON has it, so that a wrong type stays wrong."""
    if isinstance(value, dict):
        return {key: _plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    if isinstance(value, str):
        return _NULL_CHARACTER if "\0" in value else value
    if isinstance(value, int) and not isinstance(value, bool):
        return max(min(value, _MOST), -_MOST)
    if hasattr(value, "item"):  # a scalar of NumPy
        return value.item()
    return value if value is None or isinstance(value, bool | float) else [str(value)]  # a date of TOML


def _fault(error: "ErrorDetails", path: str, node: Schema) -> SettingError:
    """Return an error of pydantic with the words of a bench; `path` and `node` are those of the section."""
    kind, above = error["type"], node
    for part in error["loc"][1:]:
        above, node = node, node.get("items", {}) if isinstance(part, int) else node.get("properties", {}).get(part, {})
        path += "" if isinstance(part, int) else f".{part}"
    if kind == "value_error":
        contradiction = error["ctx"]["error"]
        return SettingError(f"{path}.{contradiction.path}", contradiction.why)
    if kind.startswith(_LIMITS):
        return SettingError(path, allowed(node), node)
    if kind == _UNKNOWN:
        return SettingError(path, unknown_key(str(error["loc"][-1]), above["properties"]))
    if kind == "missing" and above["type"] == "object":
        return SettingError(path, "is missing")
    if kind == "json_invalid":
        return SettingError(path, "is nested too deeply")
    wrong = above if kind == "missing" else node  # a list lacks elements
    length = f" of {wrong['minItems']}" if "minItems" in wrong else ""
    is_text = wrong["type"] == "string"
    without = " without null characters" if is_text and error["input"] == _NULL_CHARACTER else ""
    return SettingError(path, f"must be {_TYPES[wrong['type']]}{length}{without}")


def unknown_key(key: str, known: Collection[str]) -> str:
    """Say that a key is unknown, with the nearest and all known ones."""
    near = difflib.get_close_matches(key, known, 1)
    nearest = f": did you mean {near[0]}?" if near else ";"
    return f"is an unknown key{nearest} {'Known' if near else 'known'} are {', '.join(known)}"


def allowed(node: Schema, unit: str = "", factor: float = 1.0) -> str:
    """Say what a value must be, empty if everything goes; `factor` is the SI value of the unit."""
    node = node.get("items", node)
    if choices := node.get("enum"):
        return "must be one of " + ", ".join(f'"{choice}"' for choice in choices)
    if node.get("minLength"):
        return "must not be empty"
    is_whole = node.get("type") == "integer"
    gt, ge, le = (
        bound if bound is None else str(bound) if is_whole else _short(bound / factor)
        for bound in map(node.get, ("exclusiveMinimum", "minimum", "maximum"))
    )
    bounds = {"above": gt, "at least": ge, "at most": le}
    limit = " and ".join(f"{relation} {bound}" for relation, bound in bounds.items() if bound is not None)
    if ge is not None and le is not None:
        limit = f"{ge} or {le}" if is_whole and node["maximum"] == node["minimum"] + 1 else f"{ge} ... {le}"
    plain = {"above 0": "positive", "at least 0": "0 or positive"}.get(limit)
    return " ".join(filter(None, ("must be", plain or limit, "" if plain else unit))) if limit else ""


def _short(number: float) -> str:
    """Write a number without needless zeros: 1e-7, not 1e-07."""
    digits, _, exponent = f"{number:g}".partition("e")
    return f"{digits}e{int(exponent)}" if exponent else digits


def unit_of(name: str) -> tuple[str, str]:
    """Return the end of a setting's name that is its unit, and the unit in words; both may be empty."""
    return next(((end, unit) for end, unit in _UNIT_OF_ENDS.items() if name.endswith(end)), ("", ""))


@cache
def section_schema(cls: Any) -> Schema:
    """Return the JSON schema of a settings class, with descriptions and defaults."""
    raw = _reader(cls).json_schema()
    schema = _in_place(raw["prefixItems"][0], raw["$defs"])
    schema["description"] = (inspect.getdoc(cls) or "").splitlines()[0]
    for name, hint in get_type_hints(cls).items():
        node = schema["properties"][name]
        if (part := settings_class(hint)) is not None:
            node |= section_schema(part)
        if text := help_of(cls)[name]:
            node["description"] = text
    return schema


def settings_class(hint: Any) -> Any:
    """Return the first settings class in an annotation, None if it has none."""
    return next((part for part in (hint, *get_args(hint)) if is_dataclass(part)), None)


def _in_place(node: Schema, definitions: Schema) -> Schema:
    """Return a schema of pydantic without references, titles and null, which TOML does not have."""
    if "$ref" in node:
        node = definitions[node["$ref"].rpartition("/")[2]]
    if "anyOf" in node:  # or null
        return _in_place(node["anyOf"][0], definitions)
    made = {key: value for key, value in node.items() if key not in {"title", "prefixItems"}}
    if "prefixItems" in node:  # all alike
        made["items"] = node["prefixItems"][0]
    if "items" in made:
        made["items"] = _in_place(made["items"], definitions)
    if "properties" in made:
        made["properties"] = {name: _in_place(each, definitions) for name, each in made["properties"].items()}
    return made
