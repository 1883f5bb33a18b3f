"""The sample: its phase screen, where rays meet it, how it drifts and how its states are played."""

import bisect
import math
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from reconstruction.arrays import Floats
from reconstruction.geometry import Field, Sensor
from simulated_devices.optics.phase_screen import PhaseScreen, read_screen, shape_to_pv_and_rms, smooth_screen
from simulated_devices.optics.ray_map import RayMap, truth_wavefront
from simulated_devices.settings import Screen, Simulation

_LARGEST_SIDE = 12_000  # samples; takes 3.3 GB and a minute on two cores


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sample:
    """A phase screen in the beam."""

    screen: PhaseScreen
    ray_map: RayMap


def ray_map(screen: Screen, field: Field) -> RayMap:
    """Ray map of the place at which the settings put the screen."""
    place = RayMap.near_pupil if screen.placement == "pupil" else RayMap.near_source
    return place(distance_m=screen.distance_m, collimator_focal_length_m=field.collimator_focal_length_m)


def shift_m(simulation: Simulation, state: int) -> tuple[float, float]:
    """Drift (x, y) of the screen in state number `state`."""
    time_s = state * simulation.state_duration_s
    return simulation.screen.drift_x_m_per_s * time_s, simulation.screen.drift_y_m_per_s * time_s


def make_sample(simulation: Simulation, sensor: Sensor, field: Field) -> Sample:
    """Make the screen from its file or from the seed, large enough for every ray of every state.

    A screen from the seed without `pv_rad` is scaled so that the mean over the views of the piston-removed RMS at
    the lenslet centres, before any drift, is `rms_rad`; with `pv_rad`, the screen itself has that PV and that RMS.
    If `border_lenslets` or a drift need a larger screen than asked for, it is the same screen in its middle, and its
    middle has that RMS and PV. A screen from a file is used unchanged; the forward model rejects one that is too small.
    """
    screen, rays = simulation.screen, ray_map(simulation.screen, field)
    if screen.file:
        return Sample(screen=PhaseScreen(read_screen(Path(screen.file)), screen.sample_spacing_m), ray_map=rays)
    enlarged_by = _enlargement(simulation, sensor, field, rays)
    samples_rad = _generated(
        simulation.seed, screen.samples, screen.sample_spacing_m, screen.correlation_length_m, enlarged_by
    )
    if screen.pv_rad is not None:
        samples_rad = shape_to_pv_and_rms(
            samples_rad, pv_rad=screen.pv_rad, rms_rad=screen.rms_rad, enlarged_by=enlarged_by
        )
        return Sample(screen=PhaseScreen(samples_rad, screen.sample_spacing_m), ray_map=rays)
    unscaled = PhaseScreen(samples_rad, screen.sample_spacing_m)
    views = truth_wavefront(unscaled, rays, sensor, field)
    return Sample(screen=unscaled.scaled(screen.rms_rad / mean_view_rms(views)), ray_map=rays)


@lru_cache(maxsize=1)
def _generated(
    seed: int, samples: int, sample_spacing_m: float, correlation_length_m: float, enlarged_by: int
) -> Floats:
    """Smooth the noise of a seed once for all strengths of a screen; with fine sampling it takes seconds."""
    return smooth_screen(
        np.random.default_rng(seed),
        samples=samples,
        sample_spacing_m=sample_spacing_m,
        correlation_length_m=correlation_length_m,
        enlarged_by=enlarged_by,
    )


def mean_view_rms(wavefront: Floats) -> float:
    """Mean over views of the RMS over lenslet centres (rad) of piston-free wavefronts."""
    return float(np.sqrt((wavefront**2).mean(axis=(2, 3))).mean())


def _enlargement(simulation: Simulation, sensor: Sensor, field: Field, rays: RayMap) -> int:
    """Number of samples that rays and drift need on each side beyond those that were asked for.

    Raises `ValueError` if the generated screen, with the margins of its smoothing, is too large to compute.
    """
    rings = simulation.border_lenslets + (0 if sensor.arrangement == "square" else 1)  # hexagons overlap their cells
    border_m = rings * sensor.lenslet_pitch_m
    pupil_m = tuple(half + border_m for half in sensor.pupil_half_width_m)
    footprint_m = rays.footprint_half_width_m((pupil_m[0], pupil_m[1]), field.half_width_m)
    drift_m = np.abs(shift_m(simulation, simulation.drifting_states))
    screen = simulation.screen
    margin = 4 * screen.correlation_length_m / screen.sample_spacing_m

    def side(half_width_m: float) -> float:
        return max(screen.samples, 2 * half_width_m / screen.sample_spacing_m + 1) + 2 * margin

    half_width_m = float((footprint_m + drift_m).max())
    if not side(float(max(footprint_m))) <= _LARGEST_SIDE:
        raise ValueError(
            f"sample_spacing_m must be larger than {screen.sample_spacing_m:g}, or correlation_length_m smaller: the "
            f"screen would have {side(half_width_m):,.0f} samples a side, and the most is {_LARGEST_SIDE:,}"
        )
    if not side(half_width_m) <= _LARGEST_SIDE:
        room_m = (_LARGEST_SIDE - 1 - 2 * margin) / 2 * screen.sample_spacing_m - np.array(footprint_m)
        # The least room serves both axes; 0.5 % less allows for rounding.
        allowed = 0.995 * float(room_m.min()) / (simulation.drifting_states * simulation.state_duration_s)
        raise ValueError(
            f"drift_x_m_per_s and drift_y_m_per_s must be at most {allowed:.3g} either way with drifting_states = "
            f"{simulation.drifting_states} and sample_spacing_m = {screen.sample_spacing_m:g}: the screen would have "
            f"{side(half_width_m):,.0f} samples a side, and the most is {_LARGEST_SIDE:,}"
        )
    return max(0, math.ceil(half_width_m / screen.sample_spacing_m - (screen.samples - 1) / 2))


class Playback:
    """Shows state 0, 1, 2 ... to the last rendered one and back, `duration_s` each; `states` may grow meanwhile."""

    _REMEMBERED = 2000

    def __init__(self, *, states: int, duration_s: float, start_s: float) -> None:
        self.states = states
        self._duration_s = duration_s
        self._step = 1
        self._begins = [start_s]
        self._shown = [0]

    def state_at(self, time_s: float) -> int:
        """State shown at `time_s`, which may lie a little in the past."""
        behind = (time_s - self._begins[-1]) / self._duration_s
        if behind > self._REMEMBERED:  # after a long time without requests the film goes on where it was
            self._begins.append(time_s - self._duration_s / 2)
            self._shown.append(self._shown[-1])
        while self._begins[-1] + self._duration_s <= time_s:
            self._begins.append(self._begins[-1] + self._duration_s)
            self._shown.append(self._next())
        del self._begins[: -self._REMEMBERED], self._shown[: -self._REMEMBERED]
        return self._shown[max(0, bisect.bisect_right(self._begins, time_s) - 1)]

    def _next(self) -> int:
        state = self._shown[-1]
        if not 0 <= state + self._step < self.states:
            self._step = -self._step
        return min(max(state + self._step, 0), self.states - 1)
