"""Ray geometry of a thin screen, its light without propagation, and the true wavefronts.

The map of rays is linear: s = pupil_scale * u + field_scale * x_o, with positions u in the pupil (on the lenslets), x_o
of the object point and s on the screen; all (x, y) in m. Field positions are those of the image. A collimator inverts,
so a layer in front of the lenslets is met at u - (z / f1) x_o.

Both kinds of light, this and `PropagatedLight`, say where rays meet their plane (`ray_map`), how far a shift of the
screen moves the light in that plane (`per_shift`), and what phase (without jumps) and field the light has there.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

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
        """Screen in the collimated beam, `distance_m` before the lenslets: s = u - x_o distance / f1.

        A relay can put the screen behind the lenslets; the distance is then negative.
        """
        return cls(pupil_scale=1.0, field_scale=-distance_m / collimator_focal_length_m)

    @classmethod
    def near_source(cls, *, distance_m: float, collimator_focal_length_m: float) -> Self:
        """Screen `distance_m` after the mask: s = u distance / f1 - x_o (1 - distance / f1)."""
        scale = distance_m / collimator_focal_length_m
        return cls(pupil_scale=scale, field_scale=scale - 1.0)

    @property
    def ratio(self) -> float:
        """r of the screen, which rays meet at u + r x_o in pupil coordinates; negative before the lenslets."""
        return self.field_scale / self.pupil_scale

    def propagation_m(self, collimator_focal_length_m: float) -> float:
        """Distance in pupil coordinates over which light propagates from the screen to the lenslets."""
        return -self.ratio * collimator_focal_length_m

    def footprint_half_width_m(self, pupil_half_width_m: tuple[float, float], field_half_width_m: float) -> Floats:
        """Half the width (x, y) of the part of the screen that rays meet."""
        pupil_m = abs(self.pupil_scale) * np.asarray(pupil_half_width_m)
        return np.asarray(pupil_m + abs(self.field_scale) * field_half_width_m, np.float64)


def view_positions_m(
    ray_map: RayMap, sensor: Sensor, field: Field, shift_m: tuple[float, float] = (0.0, 0.0)
) -> tuple[Floats, Floats]:
    """Positions x and y, m, where rays of each view to the lenslets meet a plane moved by `shift_m`.

    Both broadcast to (view_row, view_column, lenslet_row, lenslet_column).
    """
    s_m = ray_map.pupil_scale * sensor.lenslet_centers_m  # (lenslet_row, lenslet_column, xy)
    x_m = s_m[..., 0] + ray_map.field_scale * field.view_x_m[:, None, None] - shift_m[0]  # (view_column, ...)
    y_m = s_m[..., 1] + ray_map.field_scale * field.view_y_m[:, None, None, None] - shift_m[1]  # (view_row, 1, ...)
    return x_m, y_m


def truth_wavefront(
    screen: PhaseScreen, ray_map: RayMap, sensor: Sensor, field: Field, shift_m: tuple[float, float] = (0.0, 0.0)
) -> Floats:
    """Wavefront of every view, rad, (view_row, view_column, lenslet_row, lenslet_column).

    Each view has no piston. `shift_m` (x, y) is the displacement of the screen.
    """
    wavefront = screen.at(*view_positions_m(ray_map, sensor, field, shift_m))
    return np.asarray(wavefront - wavefront.mean(axis=(2, 3), keepdims=True), np.float64)


class ScreenLight:
    """Light that reaches the lenslets along straight rays, as the paper simulates it."""

    per_shift = 1.0

    def __init__(self, phase: PhaseScreen, amplitude: PhaseScreen | None, rays: RayMap) -> None:
        self.phase, self.ray_map, self._amplitude = phase, rays, amplitude

    def at(self, x_m: ArrayLike, y_m: ArrayLike) -> NDArray[np.complex128]:
        """Field at positions on the screen, m, element by element."""
        amplitude = 1.0 if self._amplitude is None else self._amplitude.at(x_m, y_m)
        return np.asarray(amplitude * np.exp(1j * self.phase.at(x_m, y_m)), np.complex128)

    def column(self, x_m: Floats) -> Callable[[Floats], NDArray[np.complex64]]:
        """Field at the positions x (m), (y, x), as a function of the positions y (m)."""
        phase_at = _column(self.phase, x_m)
        amplitude_at = None if self._amplitude is None else _column(self._amplitude, x_m)

        def field(y_m: Floats) -> NDArray[np.complex64]:
            phase = phase_at(y_m)
            found = np.empty(phase.shape, np.complex64)
            np.cos(phase, out=found.real)
            np.sin(phase, out=found.imag)
            if amplitude_at is not None:
                found *= amplitude_at(y_m)
            return found

        return field


def _column(screen: PhaseScreen, x_m: Floats) -> Callable[[Floats], NDArray[np.float32]]:
    """Contract a screen's spline along x; return its values (y, x) as a function of y (m)."""
    product = screen.basis(x_m, 1) @ screen.coefficients.T.astype(np.float32)
    contracted = np.ascontiguousarray(product.T)
    return lambda y_m: np.asarray(screen.basis(y_m, 0) @ contracted, np.float32)
