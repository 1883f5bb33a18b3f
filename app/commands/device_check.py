"""Check of a connected device against the contract of its kind, for `svwfs devices --check`."""

import dataclasses
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import cattrs

from app.acquisition.devices import open_camera, open_light
from app.bench.device_settings import CameraSettings, LightSettings, drivers_of
from app.commands.device_trace import Trace
from app.errors import RunError
from drivers.camera import Camera
from drivers.contract import camera as camera_contract
from drivers.contract import light as light_contract
from drivers.contract.device import ContractBroken, describe
from drivers.device import DiscoveredDevice, Property
from drivers.errors import DeviceError, Disconnected
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
