"""Opening a bench's devices, real or simulated."""

import math
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from typing import Any, TypeAlias

from app.acquisition.watchdog_light import WatchdogLight
from app.bench.config import Bench, check_device
from app.bench.device_kinds import DRIVERS, DeviceSettings, RecordingSettings
from app.cache import cache_folder
from app.errors import InputError
from app.recording.playback_devices import playback_devices
from app.recording.reader import Recording
from drivers.interface import BadValue, Camera, Devices, LightSource
from drivers.stage import ManualStage
from reconstruction.annotated_settings import SettingError
from simulated_devices.bench import SimulatedBench, SimulatedLight, SimulatedStage
from simulated_devices.camera import SimulatedCamera
from simulated_devices.clock import Clock
from simulated_devices.rendering import Scene

_PITCH_TOLERANCE = 0.01

OpenDevices: TypeAlias = Callable[[Bench, Callable[[float], None]], Devices]  # `open_devices`, or what replaces it


def open_devices(bench: Bench, progress: Callable[[float], None]) -> Devices:
    """Open the devices of a bench; `progress` goes from 0 to 1 while a simulated one is prepared."""
    with ExitStack() as stack:
        if isinstance(settings := bench.camera, RecordingSettings):
            recording = Recording(settings.folder)
            frames = recording.select(None)
            devices = stack.enter_context(
                playback_devices(recording, frames, pace=settings.pace, repeat=settings.repeat)
            )
        elif bench.is_simulated:
            simulated = simulated_bench(bench, progress)
            stack.callback(simulated.close)
            devices = Devices(
                camera=stack.enter_context(SimulatedCamera(simulated)),
                stage=stack.enter_context(SimulatedStage(simulated)),
                light=stack.enter_context(SimulatedLight(simulated)),
            )
        else:
            devices = Devices(
                camera=stack.enter_context(open_camera(bench.camera)),
                stage=stack.enter_context(ManualStage(bench.simulation.source.mask)),
                light=stack.enter_context(open_light(bench.light)),
            )
        known_m, pitch_m = bench.sensor.pixel_pitch_m, devices.camera.capabilities.pixel_pitch_m
        if pitch_m is not None and not math.isclose(pitch_m, known_m, rel_tol=_PITCH_TOLERANCE):
            raise InputError(
                f"sensor.pixel_pitch_m = {known_m:g}, but {devices.camera.name} reports {pitch_m:g}: enter that value"
            )
        return replace(devices, _closing=stack.pop_all())


def open_camera(settings: DeviceSettings) -> Camera:
    """Open a real camera."""
    camera: Camera = _opened("camera", settings)
    return camera


def open_light(settings: DeviceSettings) -> LightSource:
    """Open a real light in a watchdog, off and at the configured current; a manual one as it is."""
    light: LightSource = _opened("light", settings)
    return light


def _opened(section: str, settings: DeviceSettings) -> Any:
    """Open a device after checking its settings, which may come from no bench; `InputError` if they are refused."""
    kind = DRIVERS[section][settings.driver]
    with ExitStack() as stack:
        try:
            check_device(section, settings)
            if not kind.device:
                raise InputError(f"{section}.driver = {settings.driver!r} has no device")
            is_guarded = section == "light" and kind.driver != "manual"
            device = stack.enter_context(WatchdogLight(settings) if is_guarded else kind.open(settings))
            if (current_a := getattr(settings, "current_a", None)) is not None:
                device.set_current(current_a)
        except SettingError as error:
            raise InputError(str(error)) from error
        except BadValue as error:
            raise InputError(f"{section}: {error}") from error
        stack.pop_all()
        return device


def simulated_bench(bench: Bench, progress: Callable[[float], None], clock: Clock | None = None) -> SimulatedBench:
    """Build the simulation of a bench, with typical devices in place of real ones, running on `clock`."""
    try:
        return SimulatedBench(
            scene_of(bench),
            bench.camera_model,
            bench.light_model,
            cache_folder=cache_folder() / "irradiance",
            clock=clock,
            progress=progress,
        )
    except ValueError as error:  # inconsistent settings, or an unusable screen file
        raise InputError(f"simulation: {error}") from error


def scene_of(bench: Bench) -> Scene:
    """Everything that the rendered images of a bench depend on."""
    camera = bench.camera_model
    return Scene(
        sensor=bench.sensor,
        lattice=bench.design_lattice(camera.rows, camera.columns),
        field=bench.field,
        simulation=bench.simulation,
        rows=camera.rows,
        columns=camera.columns,
        pixel_fill_factor=camera.pixel_fill_factor,
        lines=bench.light_model.lines,
    )
