"""Screens of the sample from a seed: their size, their phases and their transmission."""

import math
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from reconstruction.arrays import Floats
from reconstruction.geometry import Field, Sensor, require
from simulated_devices.optics.phase_screen import PhaseScreen, middle_of, read_screen, smooth_screen
from simulated_devices.optics.propagated_light import margin_m
from simulated_devices.optics.ray_map import RayMap
from simulated_devices.settings import Simulation

_LARGEST_SIDE = 8_000  # samples; takes 2 GB and half a minute on two cores
_EXTREME = 4.0  # largest slope of a screen over the RMS of its slopes
_TRANSMISSION_STREAM = 1  # of the random numbers of a seed


@dataclass(frozen=True, slots=True)
class ScreenSize:
    """Samples on each side beyond those that were asked for."""

    enlarged_by: int  # met by rays
    guard: int  # beyond them, from where light may still reach the lenslets


def shift_m(simulation: Simulation, state: int) -> tuple[float, float]:
    """Drift (x, y) of the screen in state number `state`."""
    time_s = state * simulation.state_duration_s
    return simulation.screen.drift_x_m_per_s * time_s, simulation.screen.drift_y_m_per_s * time_s


def screen_size(simulation: Simulation, sensor: Sensor, field: Field, rays: RayMap) -> ScreenSize:
    """Return how much larger rays, drift and the spread of light make the screen.

    Raises `ValueError` if the generated screen, with the margins of its smoothing, is too large to compute.
    """
    rings = simulation.border_lenslets + (0 if sensor.arrangement == "square" else 1)  # hexagons overlap their cells
    border_m = rings * sensor.lenslet_pitch_m
    pupil_m = tuple(half + border_m for half in sensor.pupil_half_width_m)
    footprint_m = rays.footprint_half_width_m((pupil_m[0], pupil_m[1]), field.half_width_m)
    guard_m = 0.0 if field.neglect_propagation else _guard_m(simulation, sensor, field, rays, float(max(footprint_m)))
    drift_m = np.abs(shift_m(simulation, simulation.drifting_states))
    screen = simulation.screen
    margin = 4 * screen.correlation_length_m / screen.sample_spacing_m

    def side(half_width_m: float) -> float:
        return max(screen.samples, 2 * (half_width_m + guard_m) / screen.sample_spacing_m + 1) + 2 * margin

    half_width_m = float((footprint_m + drift_m).max())
    if not side(float(max(footprint_m))) <= _LARGEST_SIDE:
        raise ValueError(
            f"sample_spacing_m must be larger than {screen.sample_spacing_m:g}, or correlation_length_m smaller: the "
            f"screen would have {side(half_width_m):,.0f} samples a side, and the most is {_LARGEST_SIDE:,}"
        )
    if not side(half_width_m) <= _LARGEST_SIDE:
        room_m = (_LARGEST_SIDE - 1 - 2 * margin) / 2 * screen.sample_spacing_m - np.array(footprint_m) - guard_m
        # The least room serves both axes; 0.5 % less allows for rounding.
        allowed = 0.995 * float(room_m.min()) / (simulation.drifting_states * simulation.state_duration_s)
        raise ValueError(
            f"drift_x_m_per_s and drift_y_m_per_s must be at most {allowed:.3g} either way with drifting_states = "
            f"{simulation.drifting_states} and sample_spacing_m = {screen.sample_spacing_m:g}: the screen would have "
            f"{side(half_width_m):,.0f} samples a side, and the most is {_LARGEST_SIDE:,}"
        )
    enlarged_by, with_guard = (
        max(0, math.ceil(reach_m / screen.sample_spacing_m - (screen.samples - 1) / 2))
        for reach_m in (half_width_m, half_width_m + guard_m)
    )
    return ScreenSize(enlarged_by, with_guard - enlarged_by)


def _guard_m(simulation: Simulation, sensor: Sensor, field: Field, rays: RayMap, footprint_m: float) -> float:
    """Width of the screen's rim whose light may reach the lenslets, at most that of the footprint.

    The slopes of a screen with the RMS phase R over a pupil of the width D are at most about R (1 / l + 1 / D), l the
    correlation length.
    """
    scale = abs(rays.pupil_scale)
    if scale == 0:
        return 0.0  # in the mask's plane; the light of such a screen is refused
    screen, pupil_m = simulation.screen, 2 * max(sensor.pupil_half_width_m)
    of_screen, of_pupil = scale / (math.sqrt(2) * screen.correlation_length_m), math.sqrt(6) / pupil_m
    slope_rad_per_m = _EXTREME * screen.rms_rad * (of_screen + of_pupil)
    distance_m = rays.propagation_m(field.collimator_focal_length_m)
    return min(footprint_m, scale * margin_m(slope_rad_per_m, distance_m, sensor.wavenumber_rad_per_m))


@lru_cache(maxsize=2)
def generated(
    seed: int, samples: int, sample_spacing_m: float, correlation_length_m: float, enlarged_by: int, guard: int
) -> Floats:
    """Smooth the noise of a seed once for all strengths of a screen; with fine sampling it takes seconds."""
    return smooth_screen(
        np.random.default_rng(seed),
        samples=samples,
        sample_spacing_m=sample_spacing_m,
        correlation_length_m=correlation_length_m,
        enlarged_by=enlarged_by,
        guard=guard,
    )


def amplitude_of(simulation: Simulation, phase: PhaseScreen, size: ScreenSize) -> PhaseScreen | None:
    """Square root of the transmission on the samples of a screen of that size; None if it absorbs nothing."""
    screen, shape = simulation.screen, phase.samples_rad.shape
    if screen.transmission_file:
        transmission = read_transmission(Path(screen.transmission_file))
        ring = size.enlarged_by + size.guard
        rows, columns = shape[0] - 2 * ring, shape[1] - 2 * ring
        wanted = f"transmission_file must have the {rows} x {columns} samples of the screen"
        require({wanted: transmission.shape == (rows, columns)})
        amplitude = np.sqrt(np.pad(transmission, ring, mode="reflect"))
    elif screen.transmission_rms > 0:
        amplitude = np.sqrt(_absorbing(simulation, max(shape), size)[: shape[0], : shape[1]])
    else:
        return None
    return PhaseScreen(amplitude, screen.sample_spacing_m)


def _absorbing(simulation: Simulation, side: int, size: ScreenSize) -> Floats:
    """Log-normal transmission (side, side) whose middle has the mean 1."""
    screen, ring = simulation.screen, size.enlarged_by + size.guard
    logarithm = smooth_screen(
        np.random.default_rng((simulation.seed, _TRANSMISSION_STREAM)),
        samples=side - 2 * ring,
        sample_spacing_m=screen.sample_spacing_m,
        correlation_length_m=screen.transmission_correlation_length_m,
        enlarged_by=size.enlarged_by,
        guard=size.guard,
    )
    logarithm *= math.sqrt(math.log1p(screen.transmission_rms**2)) / middle_of(logarithm, ring).std()
    transmission = np.exp(logarithm)
    return np.asarray(transmission / middle_of(transmission, ring).mean(), np.float64)


def read_transmission(path: Path) -> Floats:
    """Transmission (row, column), 0 ... 1, from a .npy or .tif file; `ValueError` of one sentence otherwise."""
    transmission = read_screen(path, "transmission_file", "values")
    require(
        {
            f"transmission_file = {str(path)!r} must hold values of 0 ... 1": (
                transmission.min() >= 0 and transmission.max() <= 1
            )
        }
    )
    return transmission
