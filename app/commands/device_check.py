"""Check of a connected device against the contract of its kind, for `svwfs devices --check`."""

from __future__ import annotations

import dataclasses
import platform
import re
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console

from app.acquisition.devices import open_camera, open_light
from app.bench.config import Bench
from app.bench.device_kinds import DRIVERS, KINDS, DeviceSettings
from app.commands import terminal
from app.errors import InputError, RunError
from app.run_facts import versions
from drivers.camera import Camera
from drivers.contract import ContractBroken, describe
from drivers.contract import camera as camera_contract
from drivers.contract import light as light_contract
from drivers.device import Property
from drivers.errors import DeviceError, Disconnected
from drivers.light_source import LightSource

_LIGHT_SHARE = 0.05  # maximum share of the light's range in a check
_SERIAL = re.compile(r"\b(?=\w*\d{5})\w+\b")  # of five digits or more, as M00331234
_OWN_KEYS = ("serial", "cameraid", "userid")
_HIDDEN = "(serial number)"


def check_and_print(name: str, bench: Bench | None = None, *, serial_numbers: bool = False) -> None:
    """Check a device against the contract of its kind, and print a report; `RunError` if it fails.

    With a bench, the name is "camera" or "light". The report can be published: serial numbers are hidden by default.
    """
    section, settings = _connected(name) if bench is None else (name, _configured(bench, name))
    log = _CheckLog(settings, is_open=serial_numbers)
    log.print_versions()
    try:
        (_check_camera if section == "camera" else _check_light)(settings, log)
    except DeviceError as error:
        raise RunError(log.public(str(error))) from error
    if log.failed:
        raise RunError(log.public(f"{name} fails {log.failed} of {log.checks} checks"))
    log.print(f"{name} passes all {log.checks} checks")


def _check_camera(settings: Any, log: _CheckLog) -> None:
    reopen = partial(open_camera, settings)
    start_s = time.perf_counter()
    with reopen() as camera:
        log.print_device(camera, start_s)
        for check in camera_contract.CAMERA_CHECKS:
            log.check(check, camera)
            camera.stop()
        log.check(camera_contract.check_closes, camera)
    with reopen() as camera:
        log.check(camera_contract.check_reopens, camera, reopen)


def _check_light(settings: Any, log: _CheckLog) -> None:
    """Check a light with a small share of its current, after a warning and Enter on a terminal."""
    start_s = time.perf_counter()
    with open_light(settings) as light:
        log.print_device(light, start_s)
        allowed = light.current_range_a
    limit_a = allowed.minimum + _LIGHT_SHARE * (allowed.maximum - allowed.minimum)
    warning = f"the light will shine with up to {limit_a * 1e3:.3g} mA, {_LIGHT_SHARE:.0%} of its range"
    if sys.stdin.isatty():
        terminal.ask(f"{warning}: make sure that no one looks into it")
    else:
        terminal.remind(warning)
    reopen = partial(open_light, dataclasses.replace(settings, current_a=None, limit_a=limit_a))
    with reopen() as light:
        for check in light_contract.LIGHT_CHECKS:
            log.check(check, light)
            light.set_on(False)
        log.check(light_contract.check_closes, light)
    with reopen() as light:
        log.check(light_contract.check_reopens, light, reopen)


class _CheckLog:
    """Checks a device and prints a report that can be published."""

    def __init__(self, settings: DeviceSettings, *, is_open: bool) -> None:
        """`is_open` shows serial numbers and the home folder."""
        self._console = Console(soft_wrap=True, highlight=False)
        self._settings, self._is_open = settings, is_open
        self._secrets = identifying_texts("", dataclasses.asdict(settings), {})
        self.checks = self.failed = 0

    def public(self, text: str) -> str:
        return text if self._is_open else hide(text, self._secrets)

    def print(self, text: str, style: str | None = None) -> None:
        self._console.print(self.public(text), style=style, markup=False)

    def print_versions(self) -> None:
        driver = self._settings.driver
        package = next((kind.package for kind in KINDS if kind.driver == driver), "")
        found = versions(package) if package else versions()
        self.print(f"svwfs {found.get('svwfs', '')}, Python {found['python']}, {platform.platform()}")
        self.print(f"driver {driver}" + (f", {package} {found.get(package, 'not installed')}" if package else ""))
        for field in dataclasses.fields(self._settings):
            value = getattr(self._settings, field.name)
            if value not in (field.default, driver) and value:
                self.print(f"  {field.name} = {value!r}")

    def print_device(self, device: Camera | LightSource, start_s: float) -> None:
        """Print what a device reports of itself whose opening began at a time of the performance counter."""
        opened_s, properties = time.perf_counter() - start_s, device.properties()
        self._secrets = identifying_texts(device.name, dataclasses.asdict(self._settings), properties)
        self.print(device.name, "bold")
        for key, value in properties.items():
            self.print(f"  {key} = {value}")
        self.print(f"opened in {opened_s:.2f} s")

    def check(self, check: Callable[..., None], device: Camera | LightSource, *more: Any) -> None:
        """Check a requirement and print the result."""
        start_s, problem = time.perf_counter(), ""
        try:
            check(device, *more)
        except Disconnected:
            raise
        except (ContractBroken, DeviceError) as error:
            problem = str(error)
        took_s = time.perf_counter() - start_s
        self.checks, self.failed = self.checks + 1, self.failed + bool(problem)
        self.print(f"  {'FAILED' if problem else 'ok':7}{took_s:7.2f} s  {describe(check)}")
        if problem:
            self.print(f"         {problem}")


def _configured(bench: Bench, name: str) -> DeviceSettings:
    if name == "camera":
        return bench.camera
    if name == "light":
        if bench.has_manual_light:
            raise InputError("the light of this bench is manual: there is nothing to check")
        return bench.light
    raise InputError(f"{name}: with --bench, --check takes camera or light")


def _connected(name: str) -> tuple[str, DeviceSettings]:
    """Return "camera" or "light", and the settings of a connected device, the others at their defaults."""
    if name in {"camera", "light"}:
        raise InputError(f"--check {name} needs --bench: whose {name}?")
    kind = next((kind for kind in KINDS if kind.driver == name.split(":", 1)[0]), None)
    if kind is None:
        known = ", ".join(kind.driver for kind in KINDS)
        raise InputError(f"{name}: not a device's name as `svwfs devices` shows it; it begins with one of {known}")
    devices, missing = kind.discover()
    for device in devices:
        if device.name == name:
            return device.kind, DRIVERS[device.kind][device.driver].settings(**device.settings)
    raise RunError(f"{name} is not connected" + (f": {missing}" if missing else "; `svwfs devices` shows what is"))


def identifying_texts(name: str, settings: Mapping[str, object], properties: Mapping[str, Property]) -> frozenset[str]:
    """Texts that identify this one device rather than its model."""
    keys = ("serial_number",) if "adapter" in settings else ("device", "serial_number")  # an adapter's is a model
    found = {str(settings.get(key) or "") for key in keys}
    found |= {str(value) for key, value in properties.items() if any(own in key.lower() for own in _OWN_KEYS)}
    for text in (each for each in (name, *properties.values()) if isinstance(each, str)):
        with suppress(ValueError):
            float(text)
            continue  # it is a number
        found |= set(_SERIAL.findall(text))
    return frozenset(text for text in found if len(text) > 3)  # a shorter one is an index


def hide(text: str, secrets: frozenset[str]) -> str:
    """Replace the secrets and the home folder."""
    for secret in sorted(secrets, key=len, reverse=True):
        text = text.replace(secret, _HIDDEN)
    return text.replace(str(Path.home()), "~")
