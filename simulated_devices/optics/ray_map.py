"""Intersection of rays with the phase screen, and the true wavefronts that follow.

The map is linear: s = pupil_scale * u + field_scale * x_o, with positions u in the pupil (on the lenslets), x_o of the
object point and s on the screen; all (x, y) in m.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np

from reconstruction.arrays import Floats
from reconstruction.geometry import Field, Sensor
from simulated_devices.optics.phase_screen import PhaseScreen


@dataclass(frozen=True, slots=True, kw_only=True)
class RayMap:
    """s = pupil_scale * u + field_scale * x_o."""

    pupil_scale: float
    field_scale: float

    @classmethod
    def near_pupil(cls, *, distance_m: float, collimator_focal_length_m: float) -> Self:
        """Screen in the collimated beam, `distance_m` before the lenslets: s = u + distance x_o / f1."""
        return cls(pupil_scale=1.0, field_scale=distance_m / collimator_focal_length_m)

    @classmethod
    def near_source(cls, *, distance_m: float, collimator_focal_length_m: float) -> Self:
        """Screen `distance_m` after the mask: s = u distance / f1 + x_o (1 - distance / f1)."""
        ratio = distance_m / collimator_focal_length_m
        return cls(pupil_scale=ratio, field_scale=1.0 - ratio)

    def footprint_half_width_m(self, pupil_half_width_m: tuple[float, float], field_half_width_m: float) -> Floats:
        """Half the width (x, y) of the part of the screen that rays meet."""
        pupil_m = abs(self.pupil_scale) * np.asarray(pupil_half_width_m)
        return np.asarray(pupil_m + abs(self.field_scale) * field_half_width_m, np.float64)


def truth_wavefront(
    screen: PhaseScreen, ray_map: RayMap, sensor: Sensor, field: Field, shift_m: tuple[float, float] = (0.0, 0.0)
) -> Floats:
    """Wavefront of every view at the lenslet centres: (view_row, view_column, lenslet_row, lenslet_column), rad.

    Each view has no piston. `shift_m` (x, y) is the displacement of the screen.
    """
    s_m = ray_map.pupil_scale * sensor.lenslet_centers_m  # (lenslet_row, lenslet_column, xy)
    x_m = s_m[..., 0] + ray_map.field_scale * field.view_x_m[:, None, None] - shift_m[0]  # (view_column, ...)
    y_m = s_m[..., 1] + ray_map.field_scale * field.view_y_m[:, None, None] - shift_m[1]  # (view_row, ...)
    wavefront = screen.at(x_m, y_m[:, None])
    return np.asarray(wavefront - wavefront.mean(axis=(2, 3), keepdims=True), np.float64)
