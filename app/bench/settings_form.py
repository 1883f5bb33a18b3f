"""Settings of a bench as a form, made from their descriptions, with labels and units."""

import copy
import dataclasses
import math
import re
import tomllib
from collections.abc import Iterator, Mapping
from typing import Any, Literal

import tomli_w

from app.bench.bench_files import BenchError
from app.bench.config import Bench, bench_schema, parse_bench, write_bench
from app.bench.device_kinds import DRIVERS
from app.bench.settings_schema import Schema, allowed, unit_of
from app.errors import InputError
from drivers.device import DiscoveredDevice
from reconstruction.modes.pupil_modes import BASES

_PREFIXES = {"n": 1e-9, "\N{MICRO SIGN}": 1e-6, "m": 1e-3, "": 1.0}
_TYPED_PREFIXES = {**_PREFIXES, "u": 1e-6, "\N{GREEK SMALL LETTER MU}": 1e-6}
_WORDS = {"rms": "RMS", "pv": "PV", "em": "EM", "center": "centre"}
NAMES = {  # of the values of settings, for people
    "gauss_newton": "Gauss-Newton",
    "itk_affine": "affine (ITK)",
    **{name: basis.title for name, basis in BASES.items()},
    **{kind.driver: kind.name for kinds in DRIVERS.values() for kind in kinds.values() if kind.name},
}
_USUAL = {"wavelength_m": "n", "current_a": "m", "pixel_m": "\N{MICRO SIGN}"}  # prefixes, whatever the value
_PREFIXED = {"m", "s", "A", "m/s"}
_NUMBER = re.compile(r"([+-]?(?:\d+[.,]?\d*|[.,]\d+)(?:[eE][+-]?\d+)?)\s*(\D*)")
_OF_LENSLETS = ("sensor", "field")  # sections without useful defaults

Kind = Literal["switch", "choice", "integer", "number", "text", "toml"]
_KINDS: dict[str, Kind] = {"boolean": "switch", "integer": "integer", "string": "text", "number": "number"}


def name_of(value: str) -> str:
    """Return the value of a setting for people: its name, or else its words."""
    return NAMES.get(value, value.replace("_", " "))


def typed_number(text: str, unit: str, factor: float) -> float | None:
    """Return a text such as "27,5 mA" in SI units; a plain number is in `unit`, `factor` SI units. None if neither."""
    match = _NUMBER.fullmatch(text.strip())
    if match is None:
        return None
    value, typed = float(match[1].replace(",", ".")), match[2].strip()
    base = unit[1:] if factor != 1 else unit
    scale: float | None = factor
    if typed not in {"", unit}:
        is_of_unit = base and typed.lower().endswith(base.lower())
        scale = _TYPED_PREFIXES.get(typed[: -len(base)]) if is_of_unit else None
    if scale is None or math.isinf(value):
        return None
    return float(f"{value * scale:.12g}")  # without the rounding error of the factor: 462 nm are 462e-9 m


@dataclasses.dataclass(frozen=True, slots=True)
class FormField:
    """One setting; a number is shown in its unit, value = shown number x `factor`."""

    path: str  # as for --set
    label: str
    kind: Kind
    text: str
    unit: str = ""
    factor: float = 1.0
    choices: tuple[str, ...] = ()
    is_optional: bool = False  # empty: chosen by the program or by the device
    help: str = ""
    example: str = ""  # of a value that must be typed

    def parse(self, text: str) -> Any:
        """Return the value that a text represents, None for an empty optional one; `InputError` if it is none."""
        text = text.strip()
        if not text and self.is_optional:
            return None
        if self.kind == "switch":
            return text == "true"
        if self.kind in {"text", "choice"}:
            return text
        if not text and self.kind == "toml":
            return []  # a list of nothing
        if self.kind == "toml":
            try:
                return tomllib.loads(f"value = {text}")["value"]
            except ValueError as error:
                raise InputError(f"{self.label}: write it as in TOML, for example {self.text or '{ }'}") from error
        number = typed_number(text, self.unit, self.factor)
        if number is None:
            raise InputError(f"{self.label}: type a number{f' in {self.unit}' if self.unit else ''}")
        if self.kind == "integer" and number != round(number):
            raise InputError(f"{self.label}: must be a whole number")
        return round(number) if self.kind == "integer" else number


@dataclasses.dataclass(frozen=True, slots=True)
class FormSection:
    """A section of the bench file."""

    path: str
    help: str
    fields: tuple[FormField, ...]


class SettingsForm:
    """The settings of a bench while they are edited; nothing is checked before `bench`."""

    def __init__(self, tree: Mapping[str, Any], *, is_new: bool = False) -> None:
        """Edit a copy of a parsed bench file; in a new bench mandatory values are examples."""
        self._tree: dict[str, Any] = tomllib.loads(tomli_w.dumps(tree))
        self._shown = copy.deepcopy(self._tree)  # as the fields were made: their texts may have fewer digits
        self._is_new = is_new
        for key in ("lenslet_rows", "lenslet_columns") if is_new else ():
            self._tree["sensor"].pop(key, None)  # a reference shows them
        self._typed: set[str] = set()  # paths

    @classmethod
    def of(cls, bench: Bench, *, is_new: bool = False) -> "SettingsForm":
        """Edit a bench, or make a new one after its example."""
        return cls(tomllib.loads(write_bench(bench)), is_new=is_new)

    def sections(self) -> tuple[FormSection, ...]:
        """Return all sections with the present values; a new bench has no simulation, and lacks what must be typed."""
        self._shown = copy.deepcopy(self._tree)
        sections: list[FormSection] = []
        for name, schema in bench_schema()["properties"].items():
            values, may_lack = self._tree.get(name, {}), "required" in schema and name not in _OF_LENSLETS
            chosen = schema
            if "oneOf" in schema:
                driver = values.get("driver", "simulated")
                chosen = next(each for each in schema["oneOf"] if each["properties"]["driver"]["const"] == driver)
            if not (self._is_new and name == "simulation"):
                sections += map(self._emptied, _sections(name, chosen, values, is_optional=may_lack))
        return tuple(sections)

    def _emptied(self, section: FormSection) -> FormSection:
        if not self._is_new or section.path not in _OF_LENSLETS:
            return section
        mandatory = bench_schema()["properties"][section.path]["required"]
        wanted = {f"{section.path}.{name}" for name in mandatory} - self._typed
        fields = (
            dataclasses.replace(field, text="", example=field.text) if field.path in wanted else field
            for field in section.fields
        )
        return dataclasses.replace(section, fields=tuple(fields))

    def set(self, field: FormField, text: str) -> None:
        """Enter a text into a field; `InputError` if it cannot be read. Another driver has other settings."""
        value = field.parse(text)
        *sections, key = field.path.split(".")
        if key == "driver":
            if value != field.text:
                self._tree[sections[0]] = {"driver": value}
            return
        tree, shown = self._tree, self._shown
        for section in sections:
            tree, shown = tree.setdefault(section, {}), shown.get(section, {})
        if text.strip() != field.text:
            self._typed.add(field.path)
        elif value is not None:
            value = shown.get(key)  # with all its digits; None if it was the default
        if value is None:
            tree.pop(key, None)  # the last one leaves an empty section
        else:
            tree[key] = value

    def use_device(self, device: DiscoveredDevice) -> None:
        """Replace the settings of the camera or the light by those of a connected device."""
        self._tree[device.kind] = {"driver": device.driver, **device.settings}

    def bench(self) -> Bench:
        """Return the bench; `BenchError` names what is wrong."""
        tree = {name: section for name, section in self._tree.items() if section}
        return parse_bench(tomli_w.dumps(tree), "the settings")


def fault_path(error: InputError) -> str:
    """Return the path of the setting that an error of a form's bench names; empty if it names none."""
    return "" if not isinstance(error, BenchError) or error.fault is None else error.fault.path


def fault_in_words(error: InputError, fields: Mapping[str, FormField]) -> str:
    """Return an error of a form's bench with labels and units of the fields in place of keys and SI units."""
    fault = getattr(error, "fault", None)
    if fault is None or fault.path not in fields:
        return str(error).removeprefix("the settings: ")
    field, why = fields[fault.path], fault.why
    if fault.limit is not None:
        return f"{field.label} {allowed(fault.limit, field.unit, field.factor)}"
    for path, other in sorted(fields.items(), key=lambda item: -len(item[0])):
        section, _, key = path.rpartition(".")
        why = why.replace(path, f"{other.label} ({section})")
        if "_" in key:  # others may be words of the sentence
            why = re.sub(rf"\b{key}\b", other.label, why)
    return f"{field.label} {why}"


def _sections(
    path: str, schema: Schema, values: Mapping[str, Any], *, is_optional: bool = False
) -> Iterator[FormSection]:
    """Yield a section with its present values, and those in it."""
    settings, required = schema["properties"], schema.get("required", ())
    nested = [name for name, each in settings.items() if "properties" in each and "required" not in each]
    fields = [
        _field(
            f"{path}.{name}",
            each,
            values.get(name, each.get("default")),
            is_optional=is_optional or (name not in required and "default" not in each),
        )
        for name, each in settings.items()
        if name not in nested
    ]
    yield FormSection(path, schema["description"], tuple(fields))
    for name in nested:
        yield from _sections(f"{path}.{name}", settings[name], values.get(name, {}))


def _field(path: str, schema: Schema, value: Any, *, is_optional: bool) -> FormField:
    """Make a field of a setting with its present value."""
    section, _, name = path.rpartition(".")
    kind, (end, unit), factor, limit = _KINDS.get(schema.get("type", ""), "toml"), unit_of(name), 1.0, allowed(schema)
    choices = tuple(DRIVERS[section]) if name == "driver" else tuple(schema.get("enum", ()))
    if choices:
        kind, limit = "choice", ""
        choices = ("",) * (is_optional and "" not in choices) + choices
    elif kind == "number" and unit in _PREFIXED:
        prefix = next((usual for of, usual in _USUAL.items() if name.endswith(of)), _prefix(value))
        unit, factor = prefix + unit, _PREFIXES[prefix]
        limit = allowed(schema, unit, factor)
    return FormField(
        path,
        _sentence(" ".join(_WORDS.get(word, word) for word in name.removesuffix(end).split("_"))),
        kind,
        _text(kind, value, factor),
        unit,
        factor,
        choices,
        is_optional or (kind == "text" and value == ""),
        ". ".join(filter(None, (schema.get("description"), _sentence(limit)))),
    )


def _prefix(value: Any) -> str:
    """Return the prefix with which a value has one to three digits before the point; none for zero."""
    if not isinstance(value, float) or value == 0:
        return "m" if value is None else ""
    return next((prefix for prefix, factor in reversed(_PREFIXES.items()) if abs(value) >= 0.9999 * factor), "n")


def _text(kind: Kind, value: Any, factor: float) -> str:
    if value is None:
        return ""
    if kind == "switch":
        return "true" if value else "false"
    if kind == "number":
        return f"{value / factor:.10g}"
    if kind == "toml":
        if isinstance(value, Mapping):
            parts = (f"{key} = {tomli_w.dumps({'v': one})[4:].strip()}" for key, one in value.items())
            return f"{{ {', '.join(parts)} }}"
        return str(value) if value else ""
    return str(value)


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:]
