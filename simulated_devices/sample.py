"""The sample: its screen from a seed or a file, its rays, its light at the lenslets, its drift."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import Floats, PointField
from reconstruction.geometry import Field, Sensor, require
from simulated_devices.optics.phase_screen import (
    PhaseScreen,
    edge_is_final,
    middle_of,
    read_screen,
    shape_to_pv_and_rms,
    smooth_screen,
)
from simulated_devices.optics.propagated_light import PropagatedLight, Propagation
from simulated_devices.optics.screen_light import RayMap, ScreenLight, truth_wavefront, view_positions_m
from simulated_devices.settings import Screen, Simulation

SampleLight: TypeAlias = ScreenLight | PropagatedLight
"""Light behind a thin sample, without the tilt of its object point."""

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
    half_width_m, margin_m = float((footprint_m + drift_m).max()), 4 * screen.correlation_length_m
    needed = (2 * (half_width_m + guard_m + margin_m) / screen.sample_spacing_m) + 1
    side = max(screen.samples + 2 * margin_m / screen.sample_spacing_m, needed)
    if not side <= _LARGEST_SIDE:
        raise ValueError(
            f"sample_spacing_m must be larger than {screen.sample_spacing_m:g}, or correlation_length_m, drift or"
            f" drifting_states smaller: the screen would have {side:,.0f} samples a side, and the most is"
            f" {_LARGEST_SIDE:,}"
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
    propagation = Propagation(
        distance_m=rays.propagation_m(field.collimator_focal_length_m), wavenumber_rad_per_m=sensor.wavenumber_rad_per_m
    )
    return min(footprint_m, scale * propagation.margin_m(slope_rad_per_m))


@lru_cache(maxsize=2)
def generated(seed: int, **shape: Any) -> Floats:
    """Call `smooth_screen` once for all strengths of a seed's screen: fine ones take seconds."""
    return smooth_screen(np.random.default_rng(seed), **shape)


def amplitude_of(simulation: Simulation, phase: PhaseScreen, size: ScreenSize) -> PhaseScreen | None:
    """Square root of the transmission on the samples of a screen of that size; None if it absorbs nothing."""
    screen, shape = simulation.screen, phase.samples_rad.shape
    if screen.transmission_file:
        path = Path(screen.transmission_file)
        transmission = read_screen(path, "transmission_file", "values")
        bounds = f"transmission_file = {str(path)!r} must hold values of 0 ... 1"
        require({bounds: transmission.min() >= 0 and transmission.max() <= 1})
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


def point_field(
    light: SampleLight, sample_x_m: Floats, sample_y_m: Floats, shift_m: tuple[float, float] = (0.0, 0.0)
) -> PointField:
    """Field of each object point at pupil samples (m) behind a sample moved by `shift_m` (x, y)."""
    rays = light.ray_map
    pupil_x_m, pupil_y_m = (
        rays.pupil_scale * along_m - light.per_shift * moved_m
        for along_m, moved_m in zip((sample_x_m, sample_y_m), shift_m, strict=True)
    )
    columns: dict[float, Callable[[Floats], NDArray[np.complex64]]] = {}  # by object x, shared by all object y

    def field(object_x_m: float, object_y_m: float) -> NDArray[np.complex64]:
        column = columns.get(object_x_m)
        if column is None:
            column = columns[object_x_m] = light.column(pupil_x_m + rays.field_scale * object_x_m)
        return column(pupil_y_m + rays.field_scale * object_y_m)

    return field


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sample:
    """A screen in the beam of a sensor, and its light at the lenslets."""

    sensor: Sensor
    field: Field
    screen: PhaseScreen
    amplitude: PhaseScreen | None  # square root of its transmission; None: it absorbs nothing
    ray_map: RayMap
    light: SampleLight

    def light_of_points(self, sample_x_m: Floats, sample_y_m: Floats, shift_m: tuple[float, float]) -> PointField:
        """Field of each object point at pupil samples (m), behind the screen moved by `shift_m` (x, y).

        Raises `ValueError` if a ray of the field's square would leave the screen.
        """
        rays = self.ray_map
        for edge_m in (-self.field.half_width_m, self.field.half_width_m):
            self.screen.at(rays.pupil_scale * sample_x_m + rays.field_scale * edge_m - shift_m[0], 0.0)
            self.screen.at(0.0, rays.pupil_scale * sample_y_m + rays.field_scale * edge_m - shift_m[1])
        return point_field(self.light, sample_x_m, sample_y_m, shift_m)

    def wavefront(self, shift_m: tuple[float, float] = (0.0, 0.0)) -> Floats:
        """True wavefront of every view: phase of the light at the lenslets, see `truth_wavefront`."""
        moved_m = self._moved_m(shift_m)
        return truth_wavefront(self.light.phase, self.light.ray_map, self.sensor, self.field, moved_m)

    def intensity(self, shift_m: tuple[float, float] = (0.0, 0.0)) -> Floats:
        """Light of every view at the lenslets over that without sample, shaped like the wavefront."""
        x_m, y_m = view_positions_m(self.light.ray_map, self.sensor, self.field, self._moved_m(shift_m))
        return np.asarray(np.abs(self.light.at(x_m, y_m)) ** 2, np.float64)

    def _moved_m(self, shift_m: tuple[float, float]) -> tuple[float, float]:
        """Shift (x, y) of the light in its plane."""
        return self.light.per_shift * shift_m[0], self.light.per_shift * shift_m[1]


def ray_map(screen: Screen, field: Field) -> RayMap:
    """Ray map of the place at which the settings put the screen."""
    place = RayMap.near_pupil if screen.placement == "pupil" else RayMap.near_source
    return place(distance_m=screen.distance_m, collimator_focal_length_m=field.collimator_focal_length_m)


def make_sample(simulation: Simulation, sensor: Sensor, field: Field, *, phase_scale: float = 1.0) -> Sample:
    """Make the screen, from file or seed, large enough for every ray of every state, and its light.

    A screen from the seed without `pv_rad` is scaled so that the mean over the views of the piston-removed RMS at
    the lenslet centres, before any drift, is `rms_rad`; with `pv_rad`, the screen itself has that PV and that RMS.
    If `border_lenslets` or a drift need a larger screen, the requested one is at its centre, and has that RMS and PV. A
    screen from a file is used unchanged; one that is too small is rejected later. `phase_scale` multiplies the phases.

    Raises `ValueError` if the screen or its light would be too large to compute, or if a file cannot be used.
    """
    screen, rays = simulation.screen, ray_map(simulation.screen, field)
    if screen.file:
        phase = wide = PhaseScreen(read_screen(Path(screen.file)), screen.sample_spacing_m).scaled(phase_scale)
        size = ScreenSize(0, 0)
    else:
        pv_rad = None if screen.pv_rad is None else screen.pv_rad * phase_scale
        simulation = replace(simulation, screen=replace(screen, rms_rad=screen.rms_rad * phase_scale, pv_rad=pv_rad))
        size = screen_size(simulation, sensor, field, rays)
        phase, wide = _generated_phases(simulation, sensor, field, rays, size)
    wide_amplitude = amplitude_of(simulation, wide, size)
    amplitude = None
    if wide_amplitude is not None:
        amplitude = PhaseScreen(middle_of(wide_amplitude.samples_rad, size.guard), screen.sample_spacing_m)
    light: SampleLight
    if field.neglect_propagation:
        light = ScreenLight(phase, amplitude, rays)
    else:
        light = PropagatedLight(
            wide,
            wide_amplitude,
            rays,
            half_width_m=phase.half_width_m,
            collimator_focal_length_m=field.collimator_focal_length_m,
            wavenumber_rad_per_m=sensor.wavenumber_rad_per_m,
        )
    return Sample(sensor=sensor, field=field, screen=phase, amplitude=amplitude, ray_map=rays, light=light)


def _generated_phases(
    simulation: Simulation, sensor: Sensor, field: Field, rays: RayMap, size: ScreenSize
) -> tuple[PhaseScreen, PhaseScreen]:
    """Screen from the seed, and the same with its guard."""
    screen, spacing_m = simulation.screen, simulation.screen.sample_spacing_m
    smoothed = partial(
        generated,
        simulation.seed,
        samples=screen.samples,
        sample_spacing_m=spacing_m,
        correlation_length_m=screen.correlation_length_m,
        enlarged_by=size.enlarged_by,
    )
    wide_rad = smoothed(guard=size.guard)
    # The edge of the screen itself is that of the ensemble, to the last bit.
    is_final = edge_is_final(screen.correlation_length_m, spacing_m)
    samples_rad = middle_of(wide_rad, size.guard).copy() if is_final else smoothed(guard=0)
    if screen.pv_rad is not None:
        shape = partial(shape_to_pv_and_rms, pv_rad=screen.pv_rad, rms_rad=screen.rms_rad)
        phase = PhaseScreen(shape(samples_rad, enlarged_by=size.enlarged_by), spacing_m)
        return phase, PhaseScreen(shape(wide_rad, enlarged_by=size.enlarged_by + size.guard), spacing_m)
    unscaled = PhaseScreen(samples_rad, spacing_m)
    scale = screen.rms_rad / mean_view_rms(truth_wavefront(unscaled, rays, sensor, field))
    return unscaled.scaled(scale), PhaseScreen(wide_rad * scale, spacing_m)


def mean_view_rms(wavefront: Floats) -> float:
    """Mean over views of the RMS over lenslet centres of wavefronts, rad, without piston.

    (view_row, view_column, lenslet_row, lenslet_column).
    """
    return float(np.sqrt((wavefront**2).mean(axis=(2, 3))).mean())


def scintillation(intensity: Floats) -> float:
    """RMS of A^2 - 1, A^2 the light (...) at the lenslets over that without sample; 0 if uniform."""
    return float(np.sqrt(np.mean((intensity - 1) ** 2)))
