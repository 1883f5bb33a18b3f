"""Settings of a bench as a form: fields made from the dataclasses, with their units, help and limits."""

import dataclasses
import inspect
import math
import re
import tomllib
from collections.abc import Iterator, Mapping
from typing import Any, Literal, get_args, get_origin, get_type_hints

import tomli_w

from app.bench.config import Bench, parse_bench, write_bench
from app.bench.device_settings import CameraSettings, LightSettings, drivers_of
from app.bench.settings_words import in_unit
from app.errors import InputError
from drivers.device import DiscoveredDevice
from drivers.frame import Region

_UNITS = {  # by the end of a name; the first that fits
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
_PREFIXES = {"n": 1e-9, "\N{MICRO SIGN}": 1e-6, "m": 1e-3, "": 1.0}
_TYPED_PREFIXES = {**_PREFIXES, "u": 1e-6, "\N{GREEK SMALL LETTER MU}": 1e-6}
_WORDS = {"rms": "RMS", "pv": "PV", "em": "EM", "center": "centre"}
_USUAL = {"wavelength_m": "n", "current_a": "m", "pixel_m": "\N{MICRO SIGN}"}  # prefixes, whatever the value
_PREFIXED = {"m", "s", "A", "m/s"}
_NUMBER = re.compile(r"([+-]?(?:\d+[.,]?\d*|[.,]\d+)(?:[eE][+-]?\d+)?)\s*(\D*)")
_COMMENT = re.compile(r"^    (\w+): [^#\n]*#\s*(.+)$", re.MULTILINE)
_UNIONS: dict[str, Any] = {"camera": CameraSettings, "light": LightSettings}
_OF_LENSLETS = ("sensor", "field")  # sections without useful defaults
_ABSURD = (-(10.0**30), 10.0**30)  # beyond all limits, to learn them

Kind = Literal["switch", "choice", "integer", "number", "text", "toml"]


def typed_number(text: str, unit: str, factor: float) -> float | None:
    """Return the number in SI units that a text such as "27,5 mA" stands for; None if it is none.

    Without a unit it counts in `unit`, which is `factor` times that without its prefix. Other prefixes of it are
    understood, and a comma or a point separates decimals.
    """
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
    is_optional: bool = False  # empty: chosen by the program or kept by the device
    help: str = ""
    example: str = ""  # of a value that must be typed

    def parse(self, text: str) -> Any:
        """Return the value that a text stands for, None for an empty optional one; `InputError` if it is none."""
        text = text.strip()
        if not text and self.is_optional:
            return None
        if self.kind == "switch":
            return text == "true"
        if self.kind in {"text", "choice"}:
            return text
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
        """Edit a copy of a parsed bench file; a new bench takes the mandatory data of its lenslets as examples."""
        self._tree: dict[str, Any] = tomllib.loads(tomli_w.dumps(tree))
        self._is_new = is_new
        self._typed: set[str] = set()  # paths

    @classmethod
    def of(cls, bench: Bench, *, is_new: bool = False) -> "SettingsForm":
        """Edit a bench, or make a new one after its example."""
        return cls(tomllib.loads(write_bench(bench)), is_new=is_new)

    def sections(self) -> tuple[FormSection, ...]:
        """Return all sections with the present values; those of camera and light belong to their drivers.

        A new bench has none of the simulation, and the fields that must be typed are empty.
        """
        hints = get_type_hints(Bench)
        return tuple(
            self._emptied(section)
            for field in dataclasses.fields(Bench)
            for section in _sections(
                field.name,
                self._class(field.name, hints[field.name]),
                self._tree.get(field.name),
                is_optional=type(None) in get_args(hints[field.name]),
            )
            if not (self._is_new and field.name == "simulation")
        )

    def _emptied(self, section: FormSection) -> FormSection:
        """Turn the values that must still be typed into examples."""
        if not self._is_new or section.path not in _OF_LENSLETS:
            return section
        cls = get_type_hints(Bench)[section.path]
        mandatory = {one.name for one in dataclasses.fields(cls) if _default(one) is dataclasses.MISSING}
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
        tree = self._tree
        for section in sections:
            tree = tree.setdefault(section, {})
        if value is None:
            tree.pop(key, None)  # the last one leaves an empty section
        elif text.strip() != field.text:  # else the digits that the text does not show stay
            tree[key] = value
            self._typed.add(field.path)

    def use_device(self, device: DiscoveredDevice) -> None:
        """Replace the settings of the camera or the light by those of a connected device."""
        self._tree[device.kind] = {"driver": device.driver, **device.settings}

    def faulty_path(self, sentence: str) -> str:
        """Return the path of the setting that an error of `bench` names; empty if it names none."""
        words = sentence.removeprefix("the settings: ").split(":")
        path, rest = words[0].strip(), ":".join(words[1:]).split()
        paths = {field.path for section in self.sections() for field in section.fields}
        named = f"{path}.{rest[0]}" if rest else path
        return next((one for one in (path, named, path.split()[0]) if one in paths), "")

    def bench(self) -> Bench:
        """Return the bench; `BenchError` names what is wrong."""
        tree = {name: section for name, section in self._tree.items() if section}
        return parse_bench(tomli_w.dumps(tree), "the settings")

    def _class(self, name: str, hint: Any) -> type:
        if name in _UNIONS:
            return drivers_of(_UNIONS[name])[self._tree.get(name, {}).get("driver", "simulated")]
        found: type = next((one for one in get_args(hint) if one is not type(None)), hint)
        return found


def _sections(
    path: str, cls: Any, values: Mapping[str, Any] | None, *, is_optional: bool = False
) -> Iterator[FormSection]:
    hints, comments = get_type_hints(cls), dict(_COMMENT.findall(inspect.getsource(cls)))
    limits = _limits(cls, values or {})
    simple, nested = [], []
    for field in dataclasses.fields(cls):
        if field.metadata:  # belongs to another section
            continue
        value = (values or {}).get(field.name, _default(field))
        if dataclasses.is_dataclass(hints[field.name]):
            nested.append((f"{path}.{field.name}", hints[field.name], (values or {}).get(field.name)))
        else:
            told = comments.get(field.name, ""), limits.get(field.name, "")
            made = _field(path, field.name, hints[field.name], value, told)
            simple.append(dataclasses.replace(made, is_optional=True) if is_optional else made)
    yield FormSection(path, (inspect.getdoc(cls) or "").splitlines()[0], tuple(simple))
    for one in nested:
        yield from _sections(*one)


def _field(path: str, name: str, hint: Any, value: Any, told: tuple[str, str]) -> FormField:
    """Make a field; `told` is what it means, and its limits in SI units."""
    is_optional = type(None) in get_args(hint)
    if is_optional:
        hint = next(one for one in get_args(hint) if one is not type(None))
    unit = next((unit for end, unit in _UNITS.items() if name.endswith(end)), "")
    end = next((end for end in _UNITS if name.endswith(end)), "")
    kind: Kind = "toml"
    choices: tuple[str, ...] = ()
    factor = 1.0
    if name == "driver":
        kind, choices = "choice", tuple(drivers_of(_UNIONS[path]))
    elif get_origin(hint) is Literal:
        kind, choices = "choice", ("",) * is_optional + get_args(hint)
    elif hint in (bool, int, str):
        kind = "switch" if hint is bool else "integer" if hint is int else "text"
    elif hint is float:
        kind = "number"
        if unit in _PREFIXED:
            prefix = next((usual for of, usual in _USUAL.items() if name.endswith(of)), _prefix(value))
            unit, factor = prefix + unit, _PREFIXES[prefix]
    words = [_WORDS.get(word, word) for word in name.removesuffix(end).split("_")]
    about = filter(None, (told[0], in_unit(told[1], unit, factor)))
    return FormField(
        f"{path}.{name}",
        _sentence(" ".join(words)),
        kind,
        _text(kind, value, factor),
        unit,
        factor,
        choices,
        is_optional or (kind == "text" and value == ""),
        ". ".join(map(_sentence, about)),
    )


def _prefix(value: Any) -> str:
    """Return the prefix with which a value has one to three digits before the point; none for zero."""
    if not isinstance(value, float) or value == 0:
        return "m" if value is None or value is dataclasses.MISSING else ""
    return next((prefix for prefix, factor in reversed(_PREFIXES.items()) if abs(value) >= 0.9999 * factor), "n")


def _text(kind: Kind, value: Any, factor: float) -> str:
    if value is None or value is dataclasses.MISSING:
        return ""
    if kind == "switch":
        return "true" if value else "false"
    if kind == "number":
        return f"{value / factor:.10g}"
    if kind == "toml":
        plain = dataclasses.asdict(value) if isinstance(value, Region) else value
        if isinstance(plain, Mapping):
            return (
                "{ "
                + ", ".join(f"{key} = {tomli_w.dumps({'v': one})[4:].strip()}" for key, one in plain.items())
                + " }"
            )
        return str(list(plain))
    return str(value)


def _default(field: "dataclasses.Field[Any]") -> Any:
    return field.default if field.default_factory is dataclasses.MISSING else field.default_factory()


def _limits(cls: Any, values: Mapping[str, Any]) -> dict[str, str]:
    """Return what a dataclass says of numbers beyond its limits, by field."""
    known = {field.name: field for field in dataclasses.fields(cls)}
    present = {name: value for name, value in values.items() if name in known and not isinstance(value, Mapping)}
    told: dict[str, str] = {}
    for name in known:
        for absurd in _ABSURD:
            try:
                cls(**{**present, name: absurd})
            except ValueError as error:
                if str(error).startswith(f"{name} must"):
                    told.setdefault(name, str(error).removeprefix(name).strip())
            except (TypeError, ArithmeticError):
                pass  # a missing or nested setting, or one that is no number
    return told


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:]
