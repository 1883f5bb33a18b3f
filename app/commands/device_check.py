"""Check of a connected device against the contract of its kind, for `svwfs devices --check`."""

import dataclasses
import platform
import re
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cattrs
from rich.console import Console

from app.acquisition.device_kinds import KINDS
from app.acquisition.devices import open_camera, open_light
from app.bench.config import Bench
from app.bench.device_settings import CameraSettings, LightSettings, drivers_of
from app.commands import terminal
from app.errors import InputError, RunError
from app.run_facts import versions
from drivers.camera import Camera
from drivers.contract import camera as camera_contract
from drivers.contract import light as light_contract
from drivers.contract.device import ContractBroken, describe
from drivers.device import DiscoveredDevice, Property
from drivers.errors import DeviceError, Disconnected
from drivers.interface import Frame
from drivers.light_source import LightSource

Warn = Callable[[str], None]

LIGHT_SHARE = 0.05  # maximum share of the light's range in a check


@dataclass(frozen=True, slots=True)
class Verdict:
    """Result of one check."""

    requirement: str
    problem: str  # how the device fails; empty if it passes
    took_s: float
    calls: tuple[str, ...]  # the last ones with their answers


def check_device(
    settings: CameraSettings | LightSettings, warn: Warn, begin: Callable[[str, Mapping[str, Property], float], None]
) -> Iterator[Verdict]:
    """Open the device and run all checks; `RunError` if it cannot be opened or is lost.

    First `begin` gets its name, its properties and how many seconds the opening took; `warn` gets a sentence on how
    bright a light will shine.
    """
    try:
        if isinstance(settings, CameraSettings):
            yield from _check_camera(partial(open_camera, settings), begin)
        else:
            yield from _check_light(settings, warn, begin)
    except DeviceError as error:
        raise RunError(str(error)) from error


def settings_of(device: DiscoveredDevice) -> CameraSettings | LightSettings:
    """Return the settings of a discovered device, the others at their defaults."""
    kind: Any = CameraSettings if device.kind == "camera" else LightSettings
    settings: CameraSettings | LightSettings = cattrs.structure(dict(device.settings), drivers_of(kind)[device.driver])
    return settings


def _check_camera(reopen: Callable[[], Camera], begin: Callable[..., None]) -> Iterator[Verdict]:
    start_s = time.perf_counter()
    with reopen() as camera:
        opened_s = time.perf_counter() - start_s
        begin(camera.name, camera.properties(), opened_s)
        for check in camera_contract.CAMERA_CHECKS:
            yield _verdict(check, camera)
            camera.stop()
        yield _verdict(camera_contract.check_closes, camera)
    with reopen() as camera:
        yield _verdict(camera_contract.check_reopens, camera, reopen)


def _check_light(settings: Any, warn: Warn, begin: Callable[..., None]) -> Iterator[Verdict]:
    start_s = time.perf_counter()
    with open_light(settings) as light:
        opened_s = time.perf_counter() - start_s
        begin(light.name, light.properties(), opened_s)
        allowed = light.current_range_a
    limit_a = allowed.minimum + LIGHT_SHARE * (allowed.maximum - allowed.minimum)
    warn(f"the light will shine with up to {limit_a * 1e3:.3g} mA, {LIGHT_SHARE:.0%} of its range")
    reopen = partial(open_light, dataclasses.replace(settings, current_a=None, limit_a=limit_a))
    with reopen() as light:
        for check in light_contract.LIGHT_CHECKS:
            yield _verdict(check, light)
            light.set_on(False)
        yield _verdict(light_contract.check_closes, light)
    with reopen() as light:
        yield _verdict(light_contract.check_reopens, light, reopen)


def _verdict(check: Callable[..., None], device: Camera | LightSource, *more: Any) -> Verdict:
    trace, start_s, problem = Trace(device), time.perf_counter(), ""
    try:
        check(trace, *more)
    except Disconnected:
        raise
    except (ContractBroken, DeviceError) as error:
        problem = str(error)
    return Verdict(describe(check), problem, time.perf_counter() - start_s, tuple(trace.calls))


_MOST_CALLS = 10  # kept
_LONGEST = 100  # characters of an answer
_SERIAL = re.compile(r"\b(?=\w*\d{5})\w+\b")  # of five digits or more, as M00331234
_OWN_KEYS = ("serial", "cameraid", "userid")
_HIDDEN = "(serial number)"


class Trace:
    """A device that notes its last calls, answers and their durations."""

    def __init__(self, device: Any) -> None:
        self._device = device
        self.calls: deque[str] = deque(maxlen=_MOST_CALLS)

    def __getattr__(self, name: str) -> Any:
        with self._noted(name) as answers:
            value = getattr(self._device, name)
            if not callable(value):
                answers.append(value)
                return value

        def call(*arguments: object) -> Any:
            with self._noted(f"{name}({', '.join(map(repr, arguments))})") as answers:
                answers.append(value(*arguments))
            return answers[0]

        return call

    @contextmanager
    def _noted(self, what: str) -> Iterator[list[Any]]:
        """Note the answer that the block appends, or its error; nothing if there is neither."""
        answers: list[Any] = []
        start_s = time.perf_counter()
        try:
            yield answers
        except Exception as error:
            answers.append(f"{type(error).__name__}: {error}")
            raise
        finally:
            if answers:
                took_s = time.perf_counter() - start_s
                self.calls.append(f"{what} -> {_short(answers[0])}, {took_s:.3f} s")


def identifying_texts(name: str, settings: Mapping[str, object], properties: Mapping[str, Property]) -> frozenset[str]:
    """Texts that identify this one device rather than its model."""
    keys = (
        ("serial_number",) if "adapter" in settings else ("device", "serial_number")
    )  # an adapter's device is a model
    found = {str(settings.get(key) or "") for key in keys}
    found |= {str(value) for key, value in properties.items() if any(own in key.lower() for own in _OWN_KEYS)}
    for text in (name, *properties.values()):
        if isinstance(text, str) and not _is_number(text):
            found |= set(_SERIAL.findall(text))
    return frozenset(text for text in found if len(text) > 3)  # a shorter one is an index


def hide(text: str, secrets: frozenset[str]) -> str:
    """Replace the secrets and the home folder."""
    for secret in sorted(secrets, key=len, reverse=True):
        text = text.replace(secret, _HIDDEN)
    return text.replace(str(Path.home()), "~")


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _short(answer: object) -> str:
    if isinstance(answer, Frame):
        rows, columns = answer.pixels.shape
        least, most = answer.pixels.min(), answer.pixels.max()
        return f"frame {answer.index}, {rows} x {columns}, counts {least} ... {most}, exposed {answer.exposure_s:g} s"
    text = f"{len(answer)} values" if isinstance(answer, Mapping) else str(answer)
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}..."


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
        self._secrets = identifying_texts("", dataclasses.asdict(settings), {})

    def public(self, text: str) -> str:
        """Return the text without what is to be hidden."""
        return text if self._is_open else hide(text, self._secrets)

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
        self._secrets = identifying_texts(name, settings, properties)
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
        terminal.ask(f"{sentence}: make sure that no one looks into it")
    else:
        terminal.remind(sentence)


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
