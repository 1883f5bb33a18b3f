"""Settings of a bench as a form, made from their descriptions, with labels and units."""

import copy
import dataclasses
import inspect
import math
import re
import tomllib
from collections.abc import Iterator, Mapping
from types import SimpleNamespace
from typing import Any, Literal, get_args, get_origin

import tomli_w

from app.bench.bench_files import BenchError
from app.bench.config import Bench, parse_bench, write_bench
from app.bench.device_kinds import DRIVERS
from app.errors import InputError
from drivers.camera import Region
from drivers.device import DiscoveredDevice
from reconstruction.annotated_settings import Setting, settings_of
from reconstruction.modes.pupil_modes import BASES

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
NAMES = {  # of the values of settings, for people
    "gauss_newton": "Gauss-Newton",
    "correlation_fft": "correlation (FFT)",
    "itk_affine": "affine (ITK)",
    **{name: basis.title for name, basis in BASES.items()},
    **{kind.driver: kind.name for kinds in DRIVERS.values() for kind in kinds.values() if kind.name},
}
_USUAL = {"wavelength_m": "n", "current_a": "m", "pixel_m": "\N{MICRO SIGN}"}  # prefixes, whatever the value
_PREFIXED = {"m", "s", "A", "m/s"}
_NUMBER = re.compile(r"([+-]?(?:\d+[.,]?\d*|[.,]\d+)(?:[eE][+-]?\d+)?)\s*(\D*)")
_OF_LENSLETS = ("sensor", "field")  # sections without useful defaults

Kind = Literal["switch", "choice", "integer", "number", "text", "toml"]
_KINDS: dict[Any, Kind] = {bool: "switch", int: "integer", str: "text", float: "number"}


def name_of(value: str) -> str:
    """Return the value of a setting for people: its name, or else its words."""
    return NAMES.get(value, value.replace("_", " "))


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
        self._typed: set[str] = set()  # paths

    @classmethod
    def of(cls, bench: Bench, *, is_new: bool = False) -> "SettingsForm":
        """Edit a bench, or make a new one after its example."""
        return cls(tomllib.loads(write_bench(bench)), is_new=is_new)

    def sections(self) -> tuple[FormSection, ...]:
        """Return all sections with the present values; those of camera and light belong to their drivers.

        A new bench has none of the simulation, and the fields that must be typed are empty.
        """
        self._shown = copy.deepcopy(self._tree)
        return tuple(
            self._emptied(section)
            for setting in settings_of(Bench)
            for section in _sections(
                setting.name, self._class(setting), self._tree.get(setting.name, {}), is_optional=setting.is_optional
            )
            if not (self._is_new and setting.name == "simulation")
        )

    def _emptied(self, section: FormSection) -> FormSection:
        if not self._is_new or section.path not in _OF_LENSLETS:
            return section
        cls = next(setting.kind for setting in settings_of(Bench) if setting.name == section.path)
        mandatory = (setting.name for setting in settings_of(cls) if setting.default is dataclasses.MISSING)
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

    def _class(self, setting: Setting) -> Any:
        if setting.name not in DRIVERS:
            return setting.kind
        return DRIVERS[setting.name][self._tree.get(setting.name, {}).get("driver", "simulated")].settings


def fault_path(error: InputError) -> str:
    """Return the path of the setting that an error of a form's bench names; empty if it names none."""
    return "" if not isinstance(error, BenchError) or error.fault is None else error.fault.path


def fault_in_words(error: InputError, fields: Mapping[str, FormField]) -> str:
    """Return an error of a form's bench with labels and units in place of keys and SI units.

    `fields` are the fields by path, as they are shown.
    """
    fault = getattr(error, "fault", None)
    if fault is None or fault.path not in fields:
        return str(error).removeprefix("the settings: ")
    field, why = fields[fault.path], fault.why
    if fault.limit is not None:
        return f"{field.label} {fault.limit.words(field.unit, field.factor)}"
    for path, other in sorted(fields.items(), key=lambda item: -len(item[0])):
        section, _, key = path.rpartition(".")
        why = why.replace(path, f"{other.label} ({section})")
        if "_" in key:  # others may be words of the sentence
            why = re.sub(rf"\b{key}\b", other.label, why)
    return f"{field.label} {why}"


def unit_of(name: str) -> tuple[str, str]:
    """Return the end of a setting's name that is its unit, and the unit in words; both may be empty."""
    return next(((end, unit) for end, unit in _UNITS.items() if name.endswith(end)), ("", ""))


def _sections(path: str, cls: Any, values: Mapping[str, Any], *, is_optional: bool = False) -> Iterator[FormSection]:
    settings = [setting for setting in settings_of(cls) if not setting.section]
    present = {setting.name: values.get(setting.name, setting.default) for setting in settings}
    nested = [setting for setting in settings if dataclasses.is_dataclass(setting.kind) and not setting.is_optional]
    fields = [
        _field(path, setting, present, is_optional=is_optional or setting.is_optional)
        for setting in settings
        if setting not in nested
    ]
    yield FormSection(path, (inspect.getdoc(cls) or "").splitlines()[0], tuple(fields))
    for setting in nested:
        yield from _sections(f"{path}.{setting.name}", setting.kind, values.get(setting.name, {}))


def _field(path: str, setting: Setting, present: Mapping[str, Any], *, is_optional: bool) -> FormField:
    """Make a field of a setting, beside the present values of its section."""
    name, value, kind = setting.name, present[setting.name], _KINDS.get(setting.kind, "toml")
    limit, (end, unit), factor = setting.limit(SimpleNamespace(**present)), unit_of(name), 1.0
    choices: tuple[str, ...] = ()
    if name == "driver":
        kind, choices, limit = "choice", tuple(DRIVERS[path]), None
    elif get_origin(setting.kind) is Literal:
        kind, choices, limit = "choice", ("",) * setting.is_optional + get_args(setting.kind), None
    elif kind == "number" and unit in _PREFIXED:
        prefix = next((usual for of, usual in _USUAL.items() if name.endswith(of)), _prefix(value))
        unit, factor = prefix + unit, _PREFIXES[prefix]
    allowed = "" if limit is None or limit.words() == "must be finite" else _sentence(limit.words(unit, factor))
    return FormField(
        f"{path}.{name}",
        _sentence(" ".join(_WORDS.get(word, word) for word in name.removesuffix(end).split("_"))),
        kind,
        _text(kind, value, factor),
        unit,
        factor,
        choices,
        is_optional or (kind == "text" and value == ""),
        ". ".join(filter(None, (setting.help, allowed))),
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
            parts = (f"{key} = {tomli_w.dumps({'v': one})[4:].strip()}" for key, one in plain.items())
            return f"{{ {', '.join(parts)} }}"
        return str(list(plain)) if len(plain) else ""
    return str(value)


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:]
