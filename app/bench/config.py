"""Bench configuration: one TOML file, read into frozen dataclasses of the packages that use them.

An invalid file raises one sentence that names the key and what is allowed.
"""

from __future__ import annotations

import dataclasses
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, TypeVar

import cattrs
import tomli_w

from app.bench.bench_error import BenchError, line_of_setting, line_of_syntax
from app.bench.bench_files import bench_file, read_bench_text
from app.bench.conversion import UNKNOWN, converter, sentence_of
from app.bench.device_settings import CameraSettings, LightSettings, drivers_of
from app.bench.earlier_versions import replace_conserve_flux, set_recorded_defaults
from app.bench.settings import RecordingSettings, StreamSettings
from app.errors import InputError
from app.files import in_words
from drivers.manual_light import ManualLightSettings
from reconstruction.deconvolution.imaging import Imaging
from reconstruction.geometry import Field, Lattice, Sensor, nominal_lattice
from reconstruction.settings import ReconstructionSettings, RegistrationSettings
from simulated_devices.settings import SimulatedCameraSettings, SimulatedLightSettings, Simulation

if TYPE_CHECKING:
    from _typeshed import DataclassInstance


Settings = TypeVar("Settings", bound="DataclassInstance")

AUTOMATIC = "automatic"  # same as omitting the setting
_CHOSEN_IF_OMITTED = (("registration", "warp"), ("reconstruction", "pupil_modes"))


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

    def __post_init__(self) -> None:
        has_real_light = not isinstance(self.light, SimulatedLightSettings)
        if has_real_light and not self.has_manual_stage:
            kind = "simulated camera" if self.is_simulated else "recording"
            raise ValueError(f'light.driver = "{self.light.driver}" cannot be used: a {kind} sees no real light')
        if self.has_manual_stage and not has_real_light:
            known = ", ".join(f'"{driver}"' for driver in drivers_of(LightSettings) if driver != "simulated")
            raise ValueError(f'light.driver is missing: camera.driver = "{self.camera.driver}" needs one of {known}')
        designed_px = self.sensor.lenslet_pitch_px
        if self.lattice is not None and not 0.9 < self.lattice.pitch_px / designed_px < 1.1:
            raise ValueError(
                f"lattice.pitch_px = {self.lattice.pitch_px:g} is far from"
                f" sensor.lenslet_pitch_m / pixel_pitch_m = {designed_px:.4g}"
            )
        shape = self.sensor.lenslet_rows, self.sensor.lenslet_columns
        for lenslet in self.registration.excluded:
            if not all(0 <= index < count for index, count in zip(lenslet, shape, strict=True)):
                raise ValueError(
                    f"registration.excluded: there is no lenslet {list(lenslet)} among {shape[0]} x {shape[1]}"
                )
        if self.lattice is not None and self.lattice.arrangement != self.sensor.arrangement:
            raise ValueError(f'lattice.arrangement = "{self.sensor.arrangement}" is missing')

    def with_toggled(self, lenslet: tuple[int, int]) -> Self:
        """Exclude a lenslet (row, column), or use it again."""
        excluded = tuple(sorted({*self.registration.excluded} ^ {lenslet}))
        return dataclasses.replace(self, registration=dataclasses.replace(self.registration, excluded=excluded))

    @property
    def is_simulated(self) -> bool:
        """True if camera, light and stage are simulated."""
        return isinstance(self.camera, SimulatedCameraSettings)

    @property
    def files(self) -> tuple[Path, ...]:
        """Files and folders that the settings name as inputs, such as a phase screen, a mask image or a recording."""
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

    def design_lattice(self, rows: int, columns: int) -> Lattice:
        """The configured lattice, or else the designed one in the middle of a frame of rows x columns pixels."""
        return self.lattice or nominal_lattice(self.sensor, rows, columns)

    @property
    def light_model(self) -> SimulatedLightSettings:
        """Settings of the light for simulations."""
        return self.light if isinstance(self.light, SimulatedLightSettings) else SimulatedLightSettings()


def load_bench(source: str | Path, overrides: tuple[str, ...] = (), *, is_recorded: bool = False) -> Bench:
    """Read a bench from a TOML file or a preset; see `parse_bench`."""
    text = read_bench_text(Path(source) if is_recorded else bench_file(source))
    return parse_bench(text, str(source), overrides, is_recorded=is_recorded)


def as_bench(bench: object) -> Bench:
    """Return a bench, or the one of a file or preset; refuse anything else."""
    if isinstance(bench, str):
        return load_bench(bench)
    if not isinstance(bench, Bench):
        raise InputError(f"a bench is needed, as load_bench returns it, not {type(bench).__name__}")
    return bench


def parse_bench(text: str, name: str, overrides: tuple[str, ...] = (), *, is_recorded: bool = False) -> Bench:
    """Parse a bench from TOML text.

    Parameters
    ----------
    text
        The bench.
    name
        Stands for it in errors.
    overrides
        "section.key=value" as in TOML.
    is_recorded
        The text comes from a recording or a result: settings unknown to its version mean what that version did.

    Raises
    ------
    BenchError
        One sentence that names the key and what is allowed, with the line.
    """
    try:
        tree = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        sentence = in_words(error)
        raise BenchError(f"{name}: not valid TOML: {sentence}", line_of_syntax(text, sentence)) from error
    if is_recorded:
        set_recorded_defaults(tree)
    for override in overrides:
        _override(tree, override)
    replace_conserve_flux(tree, text, name, is_recorded=is_recorded)
    for section, key in _CHOSEN_IF_OMITTED:
        if isinstance(tree.get(section), dict) and tree[section].get(key) == AUTOMATIC:
            del tree[section][key]
    _arrange(tree, name)
    try:
        return converter().structure(tree, Bench)
    except cattrs.BaseValidationError as error:
        faults = cattrs.transform_error(error, format_exception=sentence_of)
        faults.sort(
            key=lambda fault: not fault.startswith(UNKNOWN)
        )  # before the key that a misspelt one leaves missing
        sentence, _, path = faults[0].rpartition(" @ $")
        section = path.lstrip(".").replace("sensor.arrangement", "lattice.arrangement")
        line = None if overrides else line_of_setting(text, section, sentence)  # an override may be at fault
        raise BenchError(f"{name}: {section}{': ' if path else ''}{sentence}", line) from error


def with_known(settings: Settings, values: Mapping[str, object]) -> Settings:
    """Replace the values that these settings have; ignore the others."""
    known = {field.name for field in dataclasses.fields(settings)}
    return dataclasses.replace(settings, **{name: value for name, value in values.items() if name in known})


def write_bench(bench: Bench) -> str:
    """Return the bench as TOML text; `parse_bench` restores it exactly."""
    tree = dataclasses.asdict(bench)
    if (arrangement := tree["sensor"].pop("arrangement")) != "square":
        tree["lattice"] = (tree["lattice"] or {}) | {"arrangement": arrangement}
    return tomli_w.dumps(_without_none(tree))


def _arrange(tree: dict[str, Any], name: str) -> None:
    """Copy `lattice.arrangement` to the sensor, which has it even if the place of the lattice is not known."""
    sensor, lattice = (tree.get(section) for section in ("sensor", "lattice"))
    if isinstance(sensor, dict) and "arrangement" in sensor:
        raise BenchError(f"{name}: sensor: {UNKNOWN} arrangement; it is lattice.arrangement", line=None)
    if isinstance(sensor, dict) and isinstance(lattice, dict) and "arrangement" in lattice:
        sensor["arrangement"] = lattice["arrangement"]
        if len(lattice) == 1:
            del tree["lattice"]


def _without_none(tree: dict[str, Any]) -> dict[str, Any]:
    """Omit unset values, because TOML has no null."""
    return {
        key: _without_none(value) if isinstance(value, dict) else value
        for key, value in tree.items()
        if value is not None
    }


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
