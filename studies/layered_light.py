"""Light of a sample made of several thin layers, propagated from one to the next and to the lenslets.

In the frame that moves with the tilt of an object point x, a layer at the distance z in front of the lenslets is met at
u - (z / f1) x. The light of the farthest layer is propagated to the next one once for all points; from there on each
point has a field of its own.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import Floats, PointField
from reconstruction.geometry import Field, Sensor, centered_steps, require
from simulated_devices.optics.phase_screen import PhaseScreen, middle_of
from simulated_devices.optics.propagated_light import (
    EDGE,
    LARGEST_STEP_RAD,
    FieldSpline,
    Propagation,
    largest_step_rad,
    unwrapped_phase,
)
from simulated_devices.optics.screen_light import RayMap, ScreenLight
from simulated_devices.sample import Sample


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlacedScreen:
    """A thin screen in pupil coordinates, `distance_m` in front of the lenslets (negative: behind them)."""

    phase: PhaseScreen
    distance_m: float
    amplitude: PhaseScreen | None = None  # square root of the transmission


def layer_of(sample: Sample) -> PlacedScreen:
    """Return the screen of a sample as a layer in pupil coordinates."""
    rays, amplitude = sample.ray_map, sample.amplitude

    def seen(screen: PhaseScreen) -> PhaseScreen:
        return PhaseScreen(screen.samples_rad, screen.sample_spacing_m / rays.pupil_scale)

    return PlacedScreen(
        phase=seen(sample.screen),
        amplitude=None if amplitude is None else seen(amplitude),
        distance_m=rays.propagation_m(sample.field.collimator_focal_length_m),
    )


class LayeredLight:
    """Field of each object point behind a stack of layers, at the lenslets, without the point's own tilt."""

    def __init__(
        self, layers: Sequence[PlacedScreen], sensor: Sensor, field: Field, *, pupil_half_width_m: tuple[float, float]
    ) -> None:
        """Propagate the light of the farthest layer to the next one.

        The layers, at least one, in any order, are mirrored at their edges where they are too small. Where the field
        neglects propagation, the phases add up. `pupil_half_width_m` is half the width (x, y) of the part of the pupil
        at which the field is wanted.
        """
        require({"a layered sample needs at least one layer": len(layers) > 0})
        layers = sorted(layers, key=lambda layer: -layer.distance_m)
        slope_rad_per_m = sum(largest_step_rad(one.phase.samples_rad) / one.phase.sample_spacing_m for one in layers)
        spacing_m = min(layer.phase.sample_spacing_m for layer in layers)
        spacing_m = min(spacing_m, LARGEST_STEP_RAD / max(slope_rad_per_m, 1.0))
        places_m = [layer.distance_m for layer in layers]
        steps_m = [here - there for here, there in zip(places_m, [*places_m[1:], 0.0], strict=True)]
        if field.neglect_propagation:
            steps_m = [0.0] * len(layers)
        self._propagations = [
            Propagation(distance_m=step_m, wavenumber_rad_per_m=sensor.wavenumber_rad_per_m) for step_m in steps_m
        ]
        margins_m = [each.margin_m(slope_rad_per_m) for each in self._propagations]
        self._spacing_m = spacing_m
        self._x_m, self._y_m = (
            _grid(half_m + sum(margins_m[1:]) + EDGE * spacing_m, spacing_m) for half_m in pupil_half_width_m
        )
        self._rim = math.floor(sum(margins_m[1:]) / spacing_m)  # samples that edges may reach
        reach_m = max(self._x_m[-1], self._y_m[-1])
        ratios = [-place_m / field.collimator_focal_length_m for place_m in places_m]
        self._screens = [
            _screen_light(layer, ratio, reach_m + abs(ratio) * field.half_width_m + margins_m[0] + 2 * EDGE * spacing_m)
            for layer, ratio in zip(layers, ratios, strict=True)
        ]
        # The farthest layer's own field, propagated once.
        self._far_ratio = ratios[0]
        along_m = _grid(reach_m + abs(ratios[0]) * field.half_width_m + margins_m[0] + EDGE * spacing_m, spacing_m)
        self._far = FieldSpline(self._propagated(self._screens[0].column(along_m)(along_m), 0), spacing_m)

    def at(self, object_x_m: float, object_y_m: float) -> NDArray[np.complex128]:
        """Field of one object point on the grid of the pupil, (row, column); see `grid_m`."""
        x_m, y_m = self._x_m, self._y_m
        field = self._far.column(x_m + self._far_ratio * object_x_m)(y_m + self._far_ratio * object_y_m)
        found = field.astype(np.complex128)
        for index, screen in enumerate(self._screens[1:], 1):
            ratio = screen.ray_map.field_scale
            found *= screen.column(x_m + ratio * object_x_m)(y_m + ratio * object_y_m)
            found = self._propagated(found, index)
        return found

    def field(self, sample_x_m: Floats, sample_y_m: Floats) -> PointField:
        """Field of each object point at pupil samples, m, (column,) and (row,)."""
        return lambda x_m, y_m: FieldSpline(self.at(x_m, y_m), self._spacing_m).column(sample_x_m)(sample_y_m)

    def wavefront(self, sensor: Sensor, field: Field) -> Floats:
        """True wavefront of every view at the lenslet centres, without piston.

        (view_row, view_column, lenslet_row, lenslet_column), rad.
        """
        centers_m = sensor.lenslet_centers_m
        views = np.empty((len(field.view_y_m), len(field.view_x_m), *centers_m.shape[:2]))
        for row, y_m in enumerate(field.view_y_m):
            for column, x_m in enumerate(field.view_x_m):
                field_of_view = middle_of(self.at(float(x_m), float(y_m)), self._rim)
                phase = PhaseScreen(unwrapped_phase(field_of_view), self._spacing_m)
                views[row, column] = phase.at(centers_m[..., 0], centers_m[..., 1])
        return np.asarray(views - views.mean(axis=(2, 3), keepdims=True), np.float64)

    def _propagated(self, field: NDArray[np.complex64] | NDArray[np.complex128], index: int) -> NDArray[np.complex128]:
        """Propagate a field from one layer to the next; its rim is lost."""
        propagation = self._propagations[index]
        if propagation.distance_m == 0:
            return np.asarray(field, np.complex128)
        tapered = np.asarray(field * propagation.taper(field.shape, sample_spacing_m=self._spacing_m), np.complex128)
        return propagation(tapered, sample_spacing_m=self._spacing_m)


def _grid(half_width_m: float, spacing_m: float) -> Floats:
    """Positions about the axis that reach at least `half_width_m`, m."""
    return centered_steps(2 * math.ceil(half_width_m / spacing_m) + 1) * spacing_m


def _screen_light(layer: PlacedScreen, ratio: float, half_width_m: float) -> ScreenLight:
    """Light of a layer that reaches `half_width_m`, mirrored at its edges where it does not."""
    missing_m = half_width_m - min(layer.phase.half_width_m)
    ring = max(0, math.ceil(missing_m / layer.phase.sample_spacing_m))
    phase = np.pad(layer.phase.samples_rad, ring, mode="reflect", reflect_type="odd")
    spacing_m = layer.phase.sample_spacing_m
    amplitude = None
    if layer.amplitude is not None:
        amplitude = PhaseScreen(np.pad(layer.amplitude.samples_rad, ring, mode="reflect"), spacing_m)
    return ScreenLight(PhaseScreen(phase, spacing_m), amplitude, RayMap(pupil_scale=1.0, field_scale=ratio))
