"""A small simulated bench for tests, 3 x 4 lenslets with a clock that jumps, and faults of simulated devices."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path

from drivers.interface import BadValue, Camera, Device, DeviceError, DeviceTimeout, Disconnected, Frame
from reconstruction.geometry import Field, Lattice
from simulated_devices.bench import SimulatedBench, SimulatedLight
from simulated_devices.camera import SimulatedCamera
from simulated_devices.clock import ManualClock
from simulated_devices.rendering import Scene
from simulated_devices.settings import Screen, SimulatedCameraSettings, SimulatedLightSettings, Simulation
from support.light_log import LightLog
from support.optics import sensor_of

_OF_LIGHT = ("_read_range", "_read_current", "_is_lit", "_set_current", "_switch")
_ANSWERS = ("_read_current", "_is_lit", "_set_current")
_OF_CAMERA = ("exposure", "em_gain", "amplifier", "readout_speed", "region")
SENSOR = sensor_of(3, 4)
LATTICE = Lattice(center_x_px=70.0, center_y_px=50.0, pitch_px=31.25)
FIELD = Field(collimator_focal_length_m=0.2, half_width_m=0.6e-3)
STILL = Simulation(object_samples=5, pupil_samples=10, screen=Screen(correlation_length_m=0.5e-3, samples=150))
DRIFTING = replace(STILL, drifting_states=4, screen=replace(STILL.screen, drift_x_m_per_s=1e-3))
CAMERA = SimulatedCameraSettings(rows=100, columns=140)


def open_bench(
    folder: Path,
    simulation: Simulation = STILL,
    camera: SimulatedCameraSettings = CAMERA,
    progress: Callable[[float], None] | None = None,
) -> SimulatedBench:
    scene = Scene(
        sensor=SENSOR,
        lattice=LATTICE,
        field=FIELD,
        simulation=simulation,
        rows=camera.rows,
        columns=camera.columns,
        pixel_fill_factor=camera.pixel_fill_factor,
    )
    return SimulatedBench(
        scene, camera, SimulatedLightSettings(), cache_folder=folder, clock=ManualClock(), progress=progress
    )


def unplug(device: Device) -> None:
    """Pull the plug; a light goes out."""
    gone = Disconnected(f"the {device._kind} does not answer; is it plugged in and switched on?")
    if isinstance(device, SimulatedLight):
        device._bench.change(is_light_on=False)
        _fail(device, _OF_LIGHT, gone)
        return

    @contextmanager
    def access() -> Iterator[None]:
        with type(device)._access(device):
            raise gone
        yield

    device._access = access  # type: ignore[method-assign] # injected fault


def plug_in(device: Device) -> None:
    """Mend all faults."""
    for name in ("_access", "_read", "_start", *_OF_LIGHT):
        vars(device).pop(name, None)


def refuse_next(device: Device) -> None:
    """Refuse the next setting."""
    settings = [f"_set_{name}" for name in _OF_CAMERA] if isinstance(device, Camera) else ["_set_current"]
    _fail(device, settings, BadValue(f"the {device._kind} refused the setting"), once=True)


def fail_next(light: SimulatedLight) -> None:
    """Leave the next request without an answer."""
    _fail(light, _ANSWERS, DeviceTimeout("the light did not answer in time"), once=True)


def is_calm(light: SimulatedLight) -> bool:
    """True if no fault is to come."""
    return not any(name in vars(light) for name in _OF_LIGHT)


def stall(camera: SimulatedCamera) -> None:
    """Deliver no further frame until the camera is started again."""

    def read(timeout_s: float) -> Frame:
        camera._bench.clock.sleep(timeout_s)
        raise DeviceTimeout("no frame came in time")

    def start() -> None:
        plug_in(camera)
        camera._start()

    camera._read, camera._start = read, start  # type: ignore[method-assign] # injected fault


def lose_frames(camera: SimulatedCamera, count: int) -> None:
    """Lose the next frames."""
    camera._next_index += count


def _fail(device: Device, hooks: list[str] | tuple[str, ...], error: DeviceError, *, once: bool = False) -> None:
    """Let some methods of a device raise."""

    def raising(*_: object, **__: object) -> None:
        if once:
            for hook in hooks:
                vars(device).pop(hook, None)
        raise error

    for hook in hooks:
        setattr(device, hook, raising)


class SimulatedCameraFaults:
    """Faults of the simulated camera."""

    def __init__(self, camera: SimulatedCamera) -> None:
        self.unplug, self.plug_in, self.stall = (partial(fault, camera) for fault in (unplug, plug_in, stall))
        self.lose_frames, self.refuse_next = partial(lose_frames, camera), partial(refuse_next, camera)


class SimulatedLightFaults:
    """Faults of the simulated light, and its true state."""

    def __init__(self, bench: SimulatedBench, light: SimulatedLight) -> None:
        self._bench = bench
        self.unplug, self.plug_in, self.refuse_next = (partial(each, light) for each in (unplug, plug_in, refuse_next))
        self.fail_next = partial(fail_next, light)

    @property
    def log(self) -> LightLog:
        log = LightLog()
        for time_s, condition in self._bench.history:
            is_on = condition.is_light_on
            log.note(is_on=is_on, level=condition.current_a * is_on, time_s=time_s)
        return log


def current_state(bench: SimulatedBench) -> int:
    """State of the sample now."""
    bench._load_rendered()
    _, state = bench._image(replace(bench.condition, is_sample_in=True), bench.clock.now())
    assert state is not None
    return state


def states_rendered(bench: SimulatedBench) -> int:
    """Number of states of the sample that are rendered so far for the present mask."""
    return len(bench._films[bench.condition.mask])
