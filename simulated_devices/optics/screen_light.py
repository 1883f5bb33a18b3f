"""Light of a sample at the lenslets, in either world.

Both kinds say where rays meet their plane (`ray_map`), how far a shift of the screen moves the light in that plane
(`per_shift`), and what phase and field the light has there.
"""

from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reconstruction.arrays import Floats
from simulated_devices.optics.forward_model import PointField
from simulated_devices.optics.phase_screen import PhaseScreen
from simulated_devices.optics.ray_map import RayMap


class SampleLight(Protocol):
    """Light behind a thin sample, without the tilt of its object point."""

    ray_map: RayMap
    per_shift: float

    @property
    def phase(self) -> PhaseScreen:
        """Phase in the light's plane, without jumps."""

    def at(self, x_m: ArrayLike, y_m: ArrayLike) -> NDArray[np.complex128]:
        """Field at positions in the light's plane, m, element by element."""

    def column(self, x_m: Floats) -> Callable[[Floats], NDArray[np.complex64]]:
        """Field at the positions x (m), (y, x), as a function of the positions y (m)."""


class ScreenLight:
    """Field of the screen itself: light that reaches the lenslets along straight rays, as the paper simulates it."""

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
    product = screen.basis_x(x_m) @ screen.coefficients.T.astype(np.float32)
    contracted = np.ascontiguousarray(product.T)
    return lambda y_m: np.asarray(screen.basis_y(y_m) @ contracted, np.float32)


def point_field(
    light: SampleLight, sample_x_m: Floats, sample_y_m: Floats, shift_m: tuple[float, float] = (0.0, 0.0)
) -> PointField:
    """Field of each object point at the pupil samples (m), behind a sample that is moved by `shift_m` (x, y)."""
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
