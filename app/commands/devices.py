"""`svwfs devices`: list the connected devices, or check one of them."""

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module

import tomli_w
from rich.console import Console

from app.bench.config import Bench, CameraSettings, LightSettings
from app.commands.device_check import Verdict, check_device, settings_of
from app.commands.prompt import ask
from app.errors import InputError, RunError
from drivers.device import Property
from drivers.discovery import DiscoveredDevice
from drivers.errors import DeviceError


@dataclass(frozen=True, slots=True)
class DeviceKind:
    """A supported kind of devices, and the module that discovers them."""

    name: str
    driver: str  # as in a bench
    module: str  # has a function `discover`; imported when it is needed

    def discover(self) -> tuple[tuple[DiscoveredDevice, ...], str]:
        """Return the connected devices, and what is missing to search for them, if anything."""
        try:
            return import_module(self.module).discover(), ""
        except DeviceError as error:
            return (), str(error)


KINDS = (
    DeviceKind("Hamamatsu cameras, over the DCAM-API", "dcam", "drivers.dcam.session"),
    DeviceKind("GigE Vision and USB3 Vision cameras, over Aravis", "genicam", "drivers.genicam.discovery"),
    DeviceKind("Cameras of other makers, over Micro-Manager", "micro_manager", "drivers.micro_manager.core"),
    DeviceKind("Thorlabs DC2200 LED drivers, on USB", "thorlabs_dc2200", "drivers.usb_lights.thorlabs_dc2200"),
    DeviceKind(
        "Thorlabs DC4100 and DC4104 LED drivers, on serial ports",
        "thorlabs_dc4100",
        "drivers.serial_lights.thorlabs_dc4100",
    ),
    DeviceKind("CoolLED pE-300 and pE-4000, on serial ports", "coolled", "drivers.serial_lights.coolled"),
)


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


def check_and_print(name: str, bench: Bench | None = None) -> None:
    """Check the device of that name against the contract of its kind, and print a report; `RunError` if it fails.

    With a bench, the name is "camera" or "light", and the device is opened with the bench's settings.
    """
    settings = settings_of(_connected(name)) if bench is None else _configured(bench, name)
    console = Console(soft_wrap=True, highlight=False)
    verdicts: list[Verdict] = []
    for verdict in check_device(settings, _warn, lambda *facts: _print_device(console, *facts)):
        verdicts.append(verdict)
        console.print(f"  {'FAILED' if verdict.problem else 'ok':7}{verdict.requirement}", markup=False)
        if verdict.problem:
            console.print(f"         {verdict.problem}", markup=False)
    failed = sum(bool(verdict.problem) for verdict in verdicts)
    if failed:
        raise RunError(f"{name} fails {failed} of {len(verdicts)} checks")
    console.print(f"{name} passes all {len(verdicts)} checks", markup=False)


def _print_device(console: Console, name: str, properties: Mapping[str, Property]) -> None:
    console.print(name, style="bold", markup=False)
    for key, value in properties.items():
        console.print(f"  {key} = {value}", markup=False)


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
