"""A small simulated bench for tests: 3 x 4 lenslets on a non-square camera, with a clock that jumps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from reconstruction.geometry import Field, Lattice
from simulated_devices.bench import SimulatedBench, SimulatedLight
from simulated_devices.camera import SimulatedCamera
from simulated_devices.clock import ManualClock
from simulated_devices.rendering import Scene
from simulated_devices.settings import Screen, SimulatedCameraSettings, SimulatedLightSettings, Simulation
from support.light_log import LightLog
from support.optics import sensor_of
from support.simulated_faults import fail_next, lose_frames, plug_in, refuse_next, stall, unplug

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


class SimulatedCameraFaults:
    """Faults of the simulated camera."""

    def __init__(self, camera: SimulatedCamera) -> None:
        self._camera = camera

    def unplug(self) -> None:
        unplug(self._camera)

    def plug_in(self) -> None:
        plug_in(self._camera)

    def stall(self) -> None:
        stall(self._camera)

    def lose_frames(self, count: int) -> None:
        lose_frames(self._camera, count)

    def refuse_next(self) -> None:
        refuse_next(self._camera)


class SimulatedLightFaults:
    """Faults of the simulated light, and its true state."""

    def __init__(self, bench: SimulatedBench, light: SimulatedLight) -> None:
        self._bench, self._light = bench, light

    @property
    def log(self) -> LightLog:
        log = LightLog()
        for time_s, condition in self._bench.history:
            is_on = condition.is_light_on
            log.note(is_on=is_on, level=condition.current_a * is_on, time_s=time_s)
        return log

    def unplug(self) -> None:
        unplug(self._light)

    def plug_in(self) -> None:
        plug_in(self._light)

    def refuse_next(self) -> None:
        refuse_next(self._light)

    def fail_next(self) -> None:
        fail_next(self._light)


def current_state(bench: SimulatedBench) -> int:
    """State of the sample now."""
    bench._load_rendered()
    _, state = bench._image(replace(bench.condition, is_sample_in=True), bench.clock.now())
    assert state is not None
    return state


def states_rendered(bench: SimulatedBench) -> int:
    """Number of states of the sample that are rendered so far for the present mask."""
    return len(bench._films[bench.condition.mask])
