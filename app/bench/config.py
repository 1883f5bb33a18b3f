"""Bench configuration: one TOML file, read into frozen dataclasses of the packages that use them.

An invalid file raises one sentence that names the key and what is allowed. Nothing is converted implicitly: no text
becomes a number, and no 1 becomes true.
"""

import copy
import dataclasses
import ipaddress
import math
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Self, TypeVar, get_type_hints

import tomli_w
from annotated_types import Ge, Le
from typing_extensions import Doc

from app.bench.bench_files import BenchError, bench_file, line_of_setting, line_of_syntax, read_bench_text
from app.bench.device_kinds import DRIVERS, CameraSettings, DeviceSettings, LightSettings, RecordingSettings
from app.bench.settings_schema import Schema, read_section, section_schema, settings_class, unknown_key
from app.errors import InputError
from app.files import in_words, write_whole
from drivers.light_source import ManualLightSettings
from reconstruction.annotated_settings import Checked, SettingError, check
from reconstruction.deconvolution.imaging import Imaging
from reconstruction.frame.linearity import Linearity
from reconstruction.geometry import Field, Lattice, Sensor, nominal_lattice
from reconstruction.pupil import Pupil
from reconstruction.settings import ReconstructionSettings, RegistrationSettings
from simulated_devices.settings import SimulatedCameraSettings, SimulatedLightSettings, Simulation

if TYPE_CHECKING:
    from _typeshed import DataclassInstance


Settings = TypeVar("Settings", bound="DataclassInstance")

_SAME_WAVELENGTH = 0.01  # relative; see evidence/accuracy.md
AUTOMATIC = "automatic"  # same as omitting the setting
CHOSEN_IF_OMITTED = (("registration", "warp"), ("reconstruction", "pupil_modes"))
_IN_SENSOR = {"arrangement": "lattice.arrangement", "pupil": "pupil"}  # settings of the sensor, by their place in files
_OWN_NAMES = {"registration": ("method",), "reconstruction": ("basis",)}  # Python may give that of an own method


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class StreamSettings(Checked):
    """Port for other programs; without one nothing is published and no socket opened.

    `address` is this computer's on the network to be served; by default only this computer can connect.
    """

    port: Annotated[int, Ge(1), Le(65535)] | None = None
    address: Annotated[str, Doc("Address to publish at; 0.0.0.0 is every network")] = "127.0.0.1"

    def faults(self) -> Iterator[tuple[str, str]]:
        """Yield what no limit says."""
        try:
            ipaddress.IPv4Address(self.address)
        except ValueError:
            yield "address", "must be an IPv4 address of this computer, as 127.0.0.1"


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Bench:
    """A whole configuration; the attributes are the sections of the TOML file."""

    sensor: Sensor
    field: Field
    lattice: Lattice | None = None  # None: found in the reference
    registration: RegistrationSettings = RegistrationSettings()
    reconstruction: ReconstructionSettings = ReconstructionSettings()
    camera: CameraSettings = SimulatedCameraSettings()
    light: LightSettings = SimulatedLightSettings()
    simulation: Simulation = Simulation()
    streams: StreamSettings = StreamSettings()
    imaging: Imaging | None = None  # of images to be corrected
    linearity: Linearity | None = None  # of the camera; None: counts are proportional to light

    def __post_init__(self) -> None:
        for name in _SECTIONS:
            if (section := getattr(self, name)) is not None:
                values = dataclasses.asdict(section)
                for key in _OWN_NAMES.get(name, ()):
                    del values[key]
                read_section(_class_of(name, values), values, name)
        check(self)

    def faults(self) -> Iterator[tuple[str, str]]:
        """Yield settings that contradict those of other sections, and why."""
        has_real_light = not isinstance(self.light, SimulatedLightSettings)
        if has_real_light and not self.has_manual_stage:
            kind = "simulated camera" if self.is_simulated else "recording"
            yield "light.driver", f'= "{self.light.driver}" cannot be used: a {kind} sees no real light'
        if self.has_manual_stage and not has_real_light:
            known = ", ".join(f'"{driver}"' for driver in DRIVERS["light"] if driver != "simulated")
            yield "light.driver", f'must be one of {known} with camera.driver = "{self.camera.driver}"'
        if self.lattice is not None:
            yield from self._faults_of_lattice(self.lattice)
        if self.light_model.lines:
            mean_m = math.fsum(length_m * share for length_m, share in self.light_model.lines)
            if not math.isclose(mean_m, self.sensor.wavelength_m, rel_tol=_SAME_WAVELENGTH):
                nominal = f"sensor.wavelength_m = {self.sensor.wavelength_m:g}"
                yield "light.wavelengths_m", f"have the mean {mean_m:g}, more than 1 % from {nominal}"
        shape = self.sensor.lenslet_rows, self.sensor.lenslet_columns  # any, if omitted
        for lenslet in self.registration.excluded:
            if not all(0 <= index < (count or 1000) for index, count in zip(lenslet, shape, strict=True)):
                why = f"is wrong: there is no lenslet {list(lenslet)} among {shape[0]} x {shape[1]}"
                yield "registration.excluded", why

    def _faults_of_lattice(self, lattice: Lattice) -> Iterator[tuple[str, str]]:
        sensor = self.sensor
        if not 0.9 < lattice.pitch_px / sensor.lenslet_pitch_px < 1.1:
            ratio = f"sensor.lenslet_pitch_m / pixel_pitch_m = {sensor.lenslet_pitch_px:.4g}"
            yield "lattice.pitch_px", f"= {lattice.pitch_px:g} is far from {ratio}"
        if lattice.arrangement != sensor.arrangement:
            yield "lattice.arrangement", f'= "{sensor.arrangement}" is missing'
        for name in ("lenslet_rows", "lenslet_columns"):
            if getattr(sensor, name) is None:
                yield f"sensor.{name}", "is missing: [lattice] gives the middle of all rows and columns"

    def with_excluded(self, lenslets: Iterable[tuple[int, int]], is_excluded: bool | None) -> Self:
        """Exclude lenslets (row, column), or use them again; None: each the other way than before."""
        before, given = {*self.registration.excluded}, {*lenslets}
        after = before ^ given if is_excluded is None else before | given if is_excluded else before - given
        registration = dataclasses.replace(self.registration, excluded=tuple(sorted(after)))
        return dataclasses.replace(self, registration=registration)

    @property
    def is_simulated(self) -> bool:
        """True if camera, light and stage are simulated."""
        return isinstance(self.camera, SimulatedCameraSettings)

    @property
    def is_recording(self) -> bool:
        """True if a recording takes the place of the devices."""
        return isinstance(self.camera, RecordingSettings)

    @property
    def files(self) -> tuple[Path, ...]:
        """Input files and folders in the settings: phase screen, mask image, recording."""
        played = (Path(self.camera.folder),) if isinstance(self.camera, RecordingSettings) else ()
        return self.simulation.files + played

    @property
    def has_manual_stage(self) -> bool:
        """True if the user moves the sample, because the devices are real and there is no motor."""
        return not isinstance(self.camera, SimulatedCameraSettings | RecordingSettings)

    @property
    def has_manual_light(self) -> bool:
        """True if the user switches the light, because nothing controls it."""
        return isinstance(self.light, ManualLightSettings)

    @property
    def camera_model(self) -> SimulatedCameraSettings:
        """Settings of the camera for simulations; a typical EMCCD in place of a real one."""
        return self.camera if isinstance(self.camera, SimulatedCameraSettings) else SimulatedCameraSettings()

    @property
    def frame_shape(self) -> tuple[int, int] | None:
        """Rows and columns of a frame, px; None if they are the simulated default, or the camera's."""
        shape, usual = (self.camera_model.rows, self.camera_model.columns), SimulatedCameraSettings()
        return None if shape == (usual.rows, usual.columns) else shape

    def design_lattice(self, rows: int, columns: int) -> Lattice:
        """The configured lattice, or else the designed one in the middle of a frame of rows x columns pixels."""
        return self.lattice or nominal_lattice(self.sensor, rows, columns)

    @property
    def light_model(self) -> SimulatedLightSettings:
        """Settings of the light for simulations."""
        return self.light if isinstance(self.light, SimulatedLightSettings) else SimulatedLightSettings()


_SECTIONS = {
    field.name: settings_class(hint)
    for field, hint in zip(dataclasses.fields(Bench), get_type_hints(Bench).values(), strict=True)
}


def _class_of(name: str, values: object) -> Any:
    """Return the class of a section, which of a camera or a light depends on the driver."""
    if name not in DRIVERS or not isinstance(values, dict):
        return _SECTIONS[name]
    driver, kinds = values.get("driver", "simulated"), DRIVERS[name]
    if driver not in list(kinds):
        known = ", ".join(f'"{each}"' for each in kinds)
        raise SettingError(f"{name}.driver", f"= {driver!r} is unknown; known are {known}")
    return kinds[driver].settings


def _read(tree: Mapping[str, Any]) -> Bench:
    """Read all sections; `SettingError` with the path of the wrong key."""
    for name in tree:
        if name not in _SECTIONS:
            raise SettingError(name, unknown_key(name, [*_SECTIONS, "pupil"]))
    for field in dataclasses.fields(Bench):
        if field.default is dataclasses.MISSING and field.name not in tree:
            raise SettingError(field.name, "is missing")
    given = [name for name in _SECTIONS if name in tree]
    return Bench(**{name: read_section(_class_of(name, tree[name]), tree[name], name) for name in given})


def load_bench(source: str | Path, overrides: tuple[str, ...] = ()) -> Bench:
    """Read a bench from a TOML file or a preset; see `parse_bench`."""
    return parse_bench(read_bench_text(bench_file(source)), str(source), overrides)


def as_bench(bench: object) -> Bench:
    """Return a bench, or the one of a file or preset; refuse anything else."""
    if isinstance(bench, str):
        return load_bench(bench)
    if not isinstance(bench, Bench):
        raise InputError(f"a bench is needed, as load_bench returns it, not {type(bench).__name__}")
    return bench


def parse_bench(text: str, name: str, overrides: tuple[str, ...] = ()) -> Bench:
    """Parse a bench from TOML text and "section.key=value" overrides; `BenchError` gives key, allowed values, line."""
    try:
        tree = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        sentence = in_words(error)
        raise BenchError(f"{name}: not valid TOML: {sentence}", line_of_syntax(text, sentence)) from error
    for override in overrides:
        _override(tree, override)
    for section, key in CHOSEN_IF_OMITTED:
        if isinstance(tree.get(section), dict) and tree[section].get(key) == AUTOMATIC:
            del tree[section][key]
    _arrange(tree, name)
    try:
        bench = _read(tree)
    except SettingError as error:
        path = error.path.replace("sensor.arrangement", "lattice.arrangement").replace("sensor.pupil", "pupil")
        line = None if overrides else line_of_setting(text, path)  # an override may be at fault
        why = error.why.replace(", arrangement, pupil", "") if path.startswith("sensor.") else error.why
        fault = SettingError(path, why, error.limit)
        chosen = f', or "{AUTOMATIC}"' if tuple(path.split(".")) in CHOSEN_IF_OMITTED else ""
        raise BenchError(f"{name}: {fault}{chosen}", line, fault) from error
    return bench


def with_known(settings: Settings, values: Mapping[str, object]) -> Settings:
    """Replace the values that these settings have; ignore the others."""
    known = {field.name for field in dataclasses.fields(settings)}
    return dataclasses.replace(settings, **{name: value for name, value in values.items() if name in known})


def changes_in_words(before: Bench, after: Bench) -> str:
    """Name changed settings of the reconstruction with their new values: "pupil modes 200"."""
    texts = [
        f"{name.replace('_', ' ')} {'automatic' if value is None else value}"
        for old, new in ((before.registration, after.registration), (before.reconstruction, after.reconstruction))
        for name, value in dataclasses.asdict(new).items()
        if value != getattr(old, name)
    ]
    if not texts and before.lattice != after.lattice:
        return "the new lattice"
    return ", ".join(texts) or ("the same settings" if before.linearity == after.linearity else "the nonlinearity")


def check_device(section: str, settings: DeviceSettings) -> None:
    """Raise `SettingError` if a camera or a light cannot have these settings, which may come from no bench."""
    read_section(type(settings), dataclasses.asdict(settings), section)
    try:
        check(settings)
    except SettingError as error:
        raise SettingError(f"{section}.{error.path}", error.why) from error


@cache
def bench_schema() -> Schema:
    """Return the JSON schema of a bench file."""
    sections: dict[str, Any] = {
        name: {"oneOf": [section_schema(kind.settings) for kind in DRIVERS[name].values()]}
        if name in DRIVERS
        else copy.deepcopy(section_schema(cls))
        for name, cls in _SECTIONS.items()
    }
    del sections["sensor"]["properties"]["arrangement"]  # which stands in [lattice]
    sections["pupil"] = sections["sensor"]["properties"].pop("pupil")
    needed = [field.name for field in dataclasses.fields(Bench) if field.default is dataclasses.MISSING]
    return {"type": "object", "properties": sections, "required": needed, "additionalProperties": False}


def save_bench(path: Path, bench: Bench) -> None:
    """Write a bench into a TOML file (atomic)."""
    write_whole(path, write_bench(bench))


def write_bench(bench: Bench) -> str:
    """Return the bench as TOML text; `parse_bench` restores it exactly."""
    tree = dataclasses.asdict(bench)
    if (arrangement := tree["sensor"].pop("arrangement")) != "square":
        tree["lattice"] = (tree["lattice"] or {}) | {"arrangement": arrangement}
    if (pupil := tree["sensor"].pop("pupil")) != dataclasses.asdict(Pupil()):
        tree["pupil"] = pupil
    return tomli_w.dumps(_without_none(tree))


def _arrange(tree: dict[str, Any], name: str) -> None:
    """Give the sensor the pupil, and `lattice.arrangement`, which it has even if the lattice is unknown."""
    sensor, lattice = (tree.get(section) for section in ("sensor", "lattice"))
    for key in _IN_SENSOR.keys() & sensor if isinstance(sensor, dict) else ():
        fault = SettingError(f"sensor.{key}", f"is an unknown key; it is {_IN_SENSOR[key]}")
        raise BenchError(f"{name}: {fault}", None, fault)
    if isinstance(sensor, dict) and "pupil" in tree:
        sensor["pupil"] = tree.pop("pupil")
    if isinstance(sensor, dict) and isinstance(lattice, dict) and "arrangement" in lattice:
        sensor["arrangement"] = lattice["arrangement"]
        if len(lattice) == 1:
            del tree["lattice"]


def _without_none(tree: dict[str, Any]) -> dict[str, Any]:
    """Omit unset values, because TOML has no null."""
    set_ones = {key: value for key, value in tree.items() if value is not None}
    return {key: _without_none(value) if isinstance(value, dict) else value for key, value in set_ones.items()}


def _override(tree: dict[str, Any], override: str) -> None:
    if not isinstance(override, str):
        raise InputError(f'setting {override!r}: write text "section.key=value"')
    path, equals, value = override.partition("=")
    *sections, key = path.strip().split(".")
    try:
        read = tomllib.loads(f"value = {value}") if equals else {}
        parsed = read["value"] if len(read) == 1 else None  # a line break would begin another setting
    except (ValueError, RecursionError):
        parsed = value.strip()  # a bare word is a string
    if parsed is None or not sections or not key:
        raise InputError(f"setting {override!r}: write section.key=value, for example registration.warp=affine")
    for section in sections:
        tree = tree.setdefault(section, {})
        if not isinstance(tree, dict):
            raise InputError(f"setting {override!r}: {section} is not a section")
    tree[key] = parsed
