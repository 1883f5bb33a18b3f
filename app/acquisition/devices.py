"""Opening a bench's devices, real or simulated."""

import math
from collections.abc import Callable
from contextlib import ExitStack

from app.acquisition.watchdog_light import WatchdogLight
from app.bench.config import Bench, check_device
from app.bench.device_kinds import DRIVERS, DeviceKind, DeviceSettings, RecordingSettings
from app.cache import cache_folder
from app.errors import InputError
from app.recording.playback_devices import playback_devices
from app.recording.reader import Recording
from drivers.interface import BadValue, Camera, DeviceError, Devices, LightSource
from drivers.stage import ManualStage
from reconstruction.annotated_settings import SettingError
from simulated_devices.bench import SimulatedBench, SimulatedLight, SimulatedStage
from simulated_devices.camera import SimulatedCamera
from simulated_devices.clock import Clock
from simulated_devices.rendering import Scene

_PITCH_TOLERANCE = 0.01


def open_devices(bench: Bench, progress: Callable[[float], None]) -> Devices:
    """Open the devices of a bench; `progress` goes from 0 to 1 while a simulated one is prepared."""
    with ExitStack() as stack:
        if isinstance(settings := bench.camera, RecordingSettings):
            recording = Recording(settings.folder)
            frames = recording.select(None)
            devices = playback_devices(recording, frames, pace=settings.pace, repeat=settings.repeat)
            _check_pitch(bench, stack.enter_context(devices).camera)
            stack.pop_all()
            return devices
        if not bench.is_simulated:
            return _open_real(bench, progress, stack)
        simulated = simulated_bench(bench, progress)
        stack.callback(simulated.close)
        return Devices(
            stack.enter_context(SimulatedCamera(simulated)),
            stage=stack.enter_context(SimulatedStage(simulated)),
            light=stack.enter_context(SimulatedLight(simulated)),
            _closing=stack.pop_all(),
        )


def _open_real(bench: Bench, progress: Callable[[float], None], stack: ExitStack) -> Devices:
    """Open real devices; settings that they refuse are an `InputError`."""
    section = "camera"
    try:
        camera = stack.enter_context(open_camera(bench.camera))
        _check_pitch(bench, camera)
        progress(0.5)
        stage = stack.enter_context(ManualStage(bench.simulation.source.mask))
        section = "light"
        light = stack.enter_context(open_light(bench.light))
        progress(1.0)
    except BadValue as error:
        raise InputError(f"{section}: {error}") from error
    return Devices(camera, light, stage, stack.pop_all())


def _check_pitch(bench: Bench, camera: Camera) -> None:
    pitch_m = camera.capabilities.pixel_pitch_m
    if pitch_m is not None and not math.isclose(pitch_m, bench.sensor.pixel_pitch_m, rel_tol=_PITCH_TOLERANCE):
        raise InputError(
            f"sensor.pixel_pitch_m = {bench.sensor.pixel_pitch_m:g}, but that of {camera.name} is {pitch_m:g}"
        )


def open_camera(settings: DeviceSettings) -> Camera:
    """Open a real camera."""
    camera: Camera = _kind("camera", settings).open(settings)
    return camera


def open_light(settings: DeviceSettings) -> LightSource:
    """Open a real light in a watchdog, off and at the configured current; a manual one as it is."""
    kind = _kind("light", settings)
    light: LightSource = kind.open(settings) if kind.driver == "manual" else WatchdogLight(settings)
    current_a = getattr(settings, "current_a", None)
    if current_a is not None:
        try:
            light.set_current(current_a)
        except DeviceError:
            light.close()
            raise
    return light


def _kind(section: str, settings: DeviceSettings) -> DeviceKind:
    """Return what opens the device of these settings, after checking them: they may come from no bench."""
    try:
        check_device(section, settings)
    except SettingError as error:
        raise InputError(str(error)) from error
    kind = DRIVERS[section][settings.driver]
    if not kind.device:
        raise InputError(f"{section}.driver = {settings.driver!r} has no device of its own")
    return kind


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
