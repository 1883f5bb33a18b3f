"""The sample that the settings describe: its phase screen, where rays meet it, and how it drifts."""

from __future__ import annotations

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

_LARGEST_SIDE = 12_000  # samples; takes 3.3 GB and a minute on two cores, and grows with its square


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sample:
    """A phase screen in the beam."""

    screen: PhaseScreen
    ray_map: RayMap


def ray_map(screen: Screen, field: Field) -> RayMap:
    """Return the ray map of where the settings place the screen."""
    place = RayMap.near_pupil if screen.placement == "pupil" else RayMap.near_source
    return place(distance_m=screen.distance_m, collimator_focal_length_m=field.collimator_focal_length_m)


def shift_m(simulation: Simulation, state: int) -> tuple[float, float]:
    """How far (x, y) the screen has drifted in state number `state`."""
    time_s = state * simulation.state_duration_s
    return simulation.screen.drift_x_m_per_s * time_s, simulation.screen.drift_y_m_per_s * time_s


def make_sample(simulation: Simulation, sensor: Sensor, field: Field) -> Sample:
    """Make the screen from its file or from the seed, large enough for every ray of every state.

    A screen from the seed without `pv_rad` is scaled so that the mean over the views of the piston-removed RMS at
    the lenslet centres, before any drift, is `rms_rad`; with `pv_rad`, the screen itself has that PV and that RMS.
    A screen that has to be larger than asked, for `border_lenslets` or a drift, is the same screen in its middle, and
    it is the middle that has the asked RMS and PV: the screen of the ensemble, seed by seed, however it is lit.
    A screen from a file is used as it is; if it is too small, the forward model says so.
    """
    rays = ray_map(simulation.screen, field)
    if simulation.screen.file:
        samples_rad = read_screen(Path(simulation.screen.file))
        return Sample(screen=PhaseScreen(samples_rad, simulation.screen.sample_spacing_m), ray_map=rays)
    enlarged_by = _enlargement(simulation, sensor, field, rays)
    samples_rad = _generated(
        simulation.seed,
        samples=simulation.screen.samples,
        sample_spacing_m=simulation.screen.sample_spacing_m,
        correlation_length_m=simulation.screen.correlation_length_m,
        enlarged_by=enlarged_by,
    )
    if simulation.screen.pv_rad is not None:
        samples_rad = shape_to_pv_and_rms(
            samples_rad,
            pv_rad=simulation.screen.pv_rad,
            rms_rad=simulation.screen.rms_rad,
            enlarged_by=enlarged_by,
        )
        return Sample(screen=PhaseScreen(samples_rad, simulation.screen.sample_spacing_m), ray_map=rays)
    screen = PhaseScreen(samples_rad, simulation.screen.sample_spacing_m)
    views = truth_wavefront(screen, rays, sensor, field)
    return Sample(screen=screen.scaled(simulation.screen.rms_rad / mean_view_rms(views)), ray_map=rays)


@lru_cache(maxsize=1)
def _generated(
    seed: int, *, samples: int, sample_spacing_m: float, correlation_length_m: float, enlarged_by: int
) -> Floats:
    """Smooth the noise of a seed, once for all strengths of the same screen: a finely sampled one takes seconds."""
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
    """How many samples the rays and the drift need on each side beyond those that were asked for.

    Raises `ValueError` if the generated screen, with the margins of its smoothing, were larger than can be computed.
    """
    border_m = simulation.border_lenslets * sensor.lenslet_pitch_m
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
        # The least room serves both axes; 0.5 % less, so that rounding leads nobody over the edge.
        allowed = 0.995 * float(room_m.min()) / (simulation.drifting_states * simulation.state_duration_s)
        raise ValueError(
            f"drift_x_m_per_s and drift_y_m_per_s must be at most {allowed:.3g} either way with drifting_states = "
            f"{simulation.drifting_states} and sample_spacing_m = {screen.sample_spacing_m:g}: the screen would have "
            f"{side(half_width_m):,.0f} samples a side, and the most is {_LARGEST_SIDE:,}"
        )
    return max(0, math.ceil(half_width_m / screen.sample_spacing_m - (screen.samples - 1) / 2))
