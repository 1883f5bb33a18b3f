"""The sample: its screen, where rays meet it, its light at the lenslets and its drift."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from reconstruction.arrays import Floats
from reconstruction.geometry import Field, Sensor
from simulated_devices.optics.forward_model import PointField
from simulated_devices.optics.layered_light import Layer
from simulated_devices.optics.phase_screen import PhaseScreen, read_screen, shape_to_pv_and_rms
from simulated_devices.optics.propagated_light import PropagatedLight
from simulated_devices.optics.ray_map import RayMap, truth_wavefront, view_positions_m
from simulated_devices.optics.screen_light import SampleLight, ScreenLight, point_field
from simulated_devices.sample_screen import ScreenSize, amplitude_of, generated, screen_size
from simulated_devices.settings import Screen, Simulation


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sample:
    """A screen in the beam, and its light at the lenslets."""

    screen: PhaseScreen
    amplitude: PhaseScreen | None  # square root of its transmission; None: it absorbs nothing
    ray_map: RayMap
    light: SampleLight

    def layer(self, collimator_focal_length_m: float) -> Layer:
        """Return the screen as a layer in pupil coordinates."""
        rays = self.ray_map
        return Layer(
            phase=self.screen.magnified(1 / rays.pupil_scale),
            amplitude=None if self.amplitude is None else self.amplitude.magnified(1 / rays.pupil_scale),
            distance_m=rays.propagation_m(collimator_focal_length_m),
        )

    def field(
        self, sample_x_m: Floats, sample_y_m: Floats, field_half_width_m: float, shift_m: tuple[float, float]
    ) -> PointField:
        """Field of each object point at pupil samples (m), behind the screen moved by `shift_m` (x, y).

        Raises `ValueError` if a ray of the field's square would leave the screen.
        """
        rays = self.ray_map
        for edge_m in (-field_half_width_m, field_half_width_m):
            self.screen.at(rays.pupil_scale * sample_x_m + rays.field_scale * edge_m - shift_m[0], 0.0)
            self.screen.at(0.0, rays.pupil_scale * sample_y_m + rays.field_scale * edge_m - shift_m[1])
        return point_field(self.light, sample_x_m, sample_y_m, shift_m)

    def wavefront(self, sensor: Sensor, field: Field, shift_m: tuple[float, float] = (0.0, 0.0)) -> Floats:
        """True wavefront of every view: phase of the light at the lenslets, see `truth_wavefront`."""
        light = self.light
        moved_m = light.per_shift * shift_m[0], light.per_shift * shift_m[1]
        return truth_wavefront(light.phase, light.ray_map, sensor, field, moved_m)

    def intensity(self, sensor: Sensor, field: Field, shift_m: tuple[float, float] = (0.0, 0.0)) -> Floats:
        """Light of every view at the lenslet centres relative to that without sample.

        (view_row, view_column, lenslet_row, lenslet_column).
        """
        light = self.light
        moved_m = light.per_shift * shift_m[0], light.per_shift * shift_m[1]
        x_m, y_m = view_positions_m(light.ray_map, sensor, field, moved_m)
        return np.asarray(np.abs(light.at(x_m, y_m)) ** 2, np.float64)


def ray_map(screen: Screen, field: Field) -> RayMap:
    """Ray map of the place at which the settings put the screen."""
    place = RayMap.near_pupil if screen.placement == "pupil" else RayMap.near_source
    return place(distance_m=screen.distance_m, collimator_focal_length_m=field.collimator_focal_length_m)


def make_sample(simulation: Simulation, sensor: Sensor, field: Field) -> Sample:
    """Make the screen from its file or from the seed, large enough for every ray of every state, and its light.

    A screen from the seed without `pv_rad` is scaled so that the mean over the views of the piston-removed RMS at
    the lenslet centres, before any drift, is `rms_rad`; with `pv_rad`, the screen itself has that PV and that RMS.
    If `border_lenslets` or a drift need a larger screen, the requested one is at its centre, and has that RMS and PV. A
    screen from a file is used unchanged; one that is too small is rejected later.

    Raises
    ------
    ValueError
        If the screen or its light would be too large to compute, or if a file cannot be used.
    """
    screen, rays = simulation.screen, ray_map(simulation.screen, field)
    if screen.file:
        phase = wide = PhaseScreen(read_screen(Path(screen.file)), screen.sample_spacing_m)
        size = ScreenSize(0, 0)
    else:
        size = screen_size(simulation, sensor, field, rays)
        phase, wide = _generated_phases(simulation, sensor, field, rays, size)
    wide_amplitude = amplitude_of(simulation, wide, size)
    amplitude = None if wide_amplitude is None else wide_amplitude.without_rim(size.guard)
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
    return Sample(screen=phase, amplitude=amplitude, ray_map=rays, light=light)


def _generated_phases(
    simulation: Simulation, sensor: Sensor, field: Field, rays: RayMap, size: ScreenSize
) -> tuple[PhaseScreen, PhaseScreen]:
    """Screen from the seed, and the same with its guard."""
    screen, spacing_m = simulation.screen, simulation.screen.sample_spacing_m
    # Computed twice: the edge of the screen itself is that of the ensemble, to the last bit.
    samples_rad, wide_rad = (
        generated(simulation.seed, screen.samples, spacing_m, screen.correlation_length_m, size.enlarged_by, guard)
        for guard in (0, size.guard)
    )
    if screen.pv_rad is not None:
        shape = partial(shape_to_pv_and_rms, pv_rad=screen.pv_rad, rms_rad=screen.rms_rad)
        phase = PhaseScreen(shape(samples_rad, enlarged_by=size.enlarged_by), spacing_m)
        return phase, PhaseScreen(shape(wide_rad, enlarged_by=size.enlarged_by + size.guard), spacing_m)
    unscaled = PhaseScreen(samples_rad, spacing_m)
    scale = screen.rms_rad / mean_view_rms(truth_wavefront(unscaled, rays, sensor, field))
    return unscaled.scaled(scale), PhaseScreen(wide_rad * scale, spacing_m)


def mean_view_rms(wavefront: Floats) -> float:
    """Mean over views of the RMS over lenslet centres (rad) of piston-free wavefronts."""
    return float(np.sqrt((wavefront**2).mean(axis=(2, 3))).mean())


def scintillation(intensity: Floats) -> float:
    """RMS of A^2 - 1, A^2 the light at the lenslets relative to that without sample; 0 if it is uniform."""
    return float(np.sqrt(np.mean((intensity - 1) ** 2)))
