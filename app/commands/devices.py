"""`svwfs devices`: list the connected devices, or check one of them."""

import dataclasses
import platform
import sys
from collections.abc import Mapping

import tomli_w
from rich.console import Console

from app.acquisition.device_kinds import KINDS
from app.bench.config import Bench
from app.bench.device_settings import CameraSettings, LightSettings
from app.commands import device_trace
from app.commands.device_check import Verdict, check_device, settings_of
from app.commands.prompt import ask
from app.errors import InputError, RunError
from app.run_facts import versions
from drivers.device import DiscoveredDevice, Property


def print_devices() -> None:
    """Search for all supported devices, and print the result."""
    console = Console(soft_wrap=True, highlight=False)
    for kind in KINDS:
        devices, missing = kind.discover()
        console.print(f"[bold]{kind.name}[/bold]")
        if missing:
            console.print(f"  not searched: {missing}", markup=False)
        elif not devices:
            console.print("  none found")
        for device in devices:
            doubt = "" if device.is_certain else "perhaps a "
            console.print(f"  {device.name}   {doubt}{device.description}", markup=False)
            if device.missing:
                console.print(f"    cannot be used yet: {device.missing}", markup=False)
            section = tomli_w.dumps({device.kind: {"driver": device.driver, **device.settings}})
            for line in section.splitlines():
                console.print(f"      {line}", markup=False)


def check_and_print(name: str, bench: Bench | None = None, *, serial_numbers: bool = False) -> None:
    """Check the device of that name against the contract of its kind, and print a report; `RunError` if it fails.

    With a bench, the name is "camera" or "light", and the device is opened with the bench's settings. The report can be
    published: serial numbers are hidden unless asked for.
    """
    settings = settings_of(_connected(name)) if bench is None else _configured(bench, name)
    report = _Report(settings, is_open=serial_numbers)
    report.print_versions()
    verdicts: list[Verdict] = []
    try:
        for verdict in check_device(settings, _warn, report.print_device):
            verdicts.append(verdict)
            report.print_verdict(verdict)
    except RunError as error:
        raise RunError(report.public(str(error))) from error
    failed = sum(bool(verdict.problem) for verdict in verdicts)
    if failed:
        raise RunError(report.public(f"{name} fails {failed} of {len(verdicts)} checks"))
    report.print(f"{name} passes all {len(verdicts)} checks")


class _Report:
    """Prints a report that can be published."""

    def __init__(self, settings: CameraSettings | LightSettings, *, is_open: bool) -> None:
        """`is_open` shows serial numbers and the home folder."""
        self._console = Console(soft_wrap=True, highlight=False)
        self._settings, self._is_open = settings, is_open
        self._secrets = device_trace.serial_numbers("", dataclasses.asdict(settings), {})

    def public(self, text: str) -> str:
        """Return the text without what is to be hidden."""
        return text if self._is_open else device_trace.hide(text, self._secrets)

    def print(self, text: str, style: str | None = None) -> None:
        self._console.print(self.public(text), style=style, markup=False)

    def print_versions(self) -> None:
        """Print software, computer, and the settings that are no defaults."""
        driver = self._settings.driver
        package = next((kind.package for kind in KINDS if kind.driver == driver), "")
        found = versions(package) if package else versions()
        self.print(f"svwfs {found.get('svwfs', '')}, Python {found['python']}, {platform.platform()}")
        self.print(f"driver {driver}" + (f", {package} {found.get(package, 'not installed')}" if package else ""))
        for field in dataclasses.fields(self._settings):
            value = getattr(self._settings, field.name)
            if value not in (field.default, driver) and value:
                self.print(f"  {field.name} = {value!r}")

    def print_device(self, name: str, properties: Mapping[str, Property], opened_s: float) -> None:
        """Print what the device reports of itself."""
        settings = dataclasses.asdict(self._settings)
        self._secrets = device_trace.serial_numbers(name, settings, properties)
        self.print(name, "bold")
        for key, value in properties.items():
            self.print(f"  {key} = {value}")
        self.print(f"opened in {opened_s:.2f} s")

    def print_verdict(self, verdict: Verdict) -> None:
        """Print what was tried, and for a failure the last calls with their answers."""
        self.print(f"  {'FAILED' if verdict.problem else 'ok':7}{verdict.took_s:7.2f} s  {verdict.requirement}")
        if verdict.problem:
            self.print(f"         {verdict.problem}")
            for call in verdict.calls:
                self.print(f"           {call}")


def _warn(sentence: str) -> None:
    """Print a warning before the light shines; on a terminal wait for Enter."""
    if sys.stdin.isatty():
        ask(f"{sentence}: make sure that no one looks into it")
    else:
        sys.stderr.write(f"{sentence}\n")


def _configured(bench: Bench, name: str) -> CameraSettings | LightSettings:
    if name == "camera":
        return bench.camera
    if name == "light":
        if bench.has_manual_light:
            raise InputError("the light of this bench is manual: there is nothing to check")
        return bench.light
    raise InputError(f"{name}: with --bench, --check takes camera or light")


def _connected(name: str) -> DiscoveredDevice:
    kind = next((kind for kind in KINDS if kind.driver == name.split(":", 1)[0]), None)
    if kind is None:
        known = ", ".join(kind.driver for kind in KINDS)
        raise InputError(f"{name}: not a device's name as `svwfs devices` shows it; it begins with one of {known}")
    devices, missing = kind.discover()
    for device in devices:
        if device.name == name:
            return device
    raise RunError(f"{name} is not connected" + (f": {missing}" if missing else "; `svwfs devices` shows what is"))
