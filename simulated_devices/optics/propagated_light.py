"""Light of a thin screen at the lenslets, with what diffraction does on the way.

The light of one object point behind the screen is exp(i Phi) sqrt(transmission) times the point's tilt. Fresnel
propagation shifts with the tilt, so the field at the lenslets is U_z(u + r x) for all object points x: U_z is the
screen's own field, propagated once by the distance z = -r f1 in pupil coordinates. A screen that moves shifts U_z.
A bicubic spline gives it between its samples; products with sparse bases evaluate it on grids of x and y.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
import scipy  # which loads its parts when they are used
from numpy.typing import ArrayLike, NDArray
from scipy import fft, ndimage, sparse

from reconstruction.arrays import Floats
from reconstruction.geometry import require
from simulated_devices.optics.phase_screen import PhaseScreen
from simulated_devices.optics.screen_light import RayMap

_CUBIC: Final = 3
EDGE = 8
"""Samples around the used part of a field; beyond them a spline does not feel that its edge is mirrored."""


class FieldSpline:
    """Complex field between its samples (row, column); exact for positions `EDGE` within its edge."""

    def __init__(self, samples: NDArray[np.complex128], sample_spacing_m: float) -> None:
        self._shape, self._spacing_m = samples.shape, sample_spacing_m
        self._coefficients = ndimage.spline_filter(samples, _CUBIC, np.complex128, mode="mirror")
        # Real and imaginary parts interleaved along y: (coefficient column, 2 x coefficient row).
        self._by_column = np.ascontiguousarray(self._coefficients.T.astype(np.complex64)).view(np.float32)

    def at(self, x_m: ArrayLike, y_m: ArrayLike) -> NDArray[np.complex128]:
        """Field at positions in m, element by element; x and y broadcast against each other."""
        x, y = np.broadcast_arrays(self._index(np.asarray(x_m), 1), self._index(np.asarray(y_m), 0))
        return np.asarray(
            ndimage.map_coordinates(self._coefficients, np.stack([y, x]), order=_CUBIC, prefilter=False, mode="mirror")
        )

    def column(self, x_m: Floats) -> Callable[[Floats], NDArray[np.complex64]]:
        """Contract the spline at positions x (m): the field (y, x) as a function of positions y (m)."""
        product = self._basis(x_m, 1) @ self._by_column
        by_row = product.reshape(len(x_m), -1, 2).transpose(1, 0, 2)
        contracted = np.ascontiguousarray(by_row).reshape(self._shape[0], -1)  # (row, 2 x)
        return lambda y_m: np.asarray(self._basis(y_m, 0) @ contracted).view(np.complex64)

    def _index(self, position_m: Floats, axis: int) -> Floats:
        """Position in samples from the first one."""
        return np.asarray(position_m / self._spacing_m + (self._shape[axis] - 1) / 2, np.float64)

    def _basis(self, position_m: Floats, axis: int) -> sparse.csr_array[np.float32]:
        """Values of the spline's basis: sparse (position, coefficient), four entries a row."""
        knots = np.arange(self._shape[axis] + _CUBIC + 1) - 2.0
        return scipy.interpolate.BSpline.design_matrix(self._index(position_m, axis), knots, _CUBIC).astype(np.float32)


LARGEST_STEP_RAD = 0.5  # of the phase between samples; the spline then errs by about 1e-4
_LARGEST_SIDE = 8192  # samples; takes 4 GB
_ROUNDING = 1e-6  # samples
_TAPER = 2.0  # Fresnel lengths


@dataclass(frozen=True, slots=True, kw_only=True)
class Propagation:
    """Fresnel propagation of light over a distance, which may be negative."""

    distance_m: float
    wavenumber_rad_per_m: float

    def __call__(self, field: NDArray[np.complex128], *, sample_spacing_m: float) -> NDArray[np.complex128]:
        """Propagate a periodic field (row, column).

        A positive phase slope moves light towards +x: the transfer function is exp(-i z (kx^2 + ky^2) / 2k).
        """
        ky, kx = (2 * math.pi * fft.fftfreq(count, sample_spacing_m) for count in field.shape)
        along_y, along_x = (np.exp(-0.5j * self.distance_m / self.wavenumber_rad_per_m * k**2) for k in (ky, kx))
        spectrum = fft.fft2(field)
        spectrum *= along_y[:, None]
        spectrum *= along_x
        return np.asarray(fft.ifft2(spectrum, overwrite_x=True), np.complex128)

    def margin_m(self, slope_rad_per_m: float) -> float:
        """Width of a field's rim from which light of such a slope may reach the middle, with diffraction.

        The outer half of what diffraction needs is for the `taper`.
        """
        return slope_rad_per_m / self.wavenumber_rad_per_m * abs(self.distance_m) + 2 * _TAPER * self._fresnel_length_m

    def taper(self, shape: tuple[int, ...], *, sample_spacing_m: float) -> Floats:
        """Amplitude (row, column) that falls to 0 at the edge so gently that little of it is diffracted."""
        width = max(1.0, _TAPER * self._fresnel_length_m / sample_spacing_m)
        along_y, along_x = (
            np.sin(np.pi / 2 * np.minimum(np.minimum(index + 0.5, index[::-1] + 0.5) / width, 1)) ** 2
            for index in map(np.arange, shape)
        )
        return np.asarray(np.outer(along_y, along_x), np.float64)

    @property
    def _fresnel_length_m(self) -> float:
        """Width sqrt(lambda z) over which diffraction blurs an edge."""
        return math.sqrt(2 * math.pi / self.wavenumber_rad_per_m * abs(self.distance_m))


def largest_step_rad(phase_rad: Floats) -> float:
    """Largest change of the phase (row, column) between neighbours, rad."""
    return max(float(np.abs(np.diff(phase_rad, axis=axis)).max()) for axis in range(2))


class PropagatedLight(FieldSpline):
    """Field U_z of a screen at the lenslets, in pupil coordinates."""

    def __init__(
        self,
        screen: PhaseScreen,
        amplitude: PhaseScreen | None,
        rays: RayMap,
        *,
        half_width_m: tuple[float, float],
        collimator_focal_length_m: float,
        wavenumber_rad_per_m: float,
    ) -> None:
        """Propagate the field of a screen.

        `half_width_m` is half the width (x, y) of the part that is used. The screen may be larger than that, so that
        nothing feels its edge. `amplitude` is the square root of its transmission on the same samples; None: 1
        everywhere.
        """
        require({"distance_m must be positive: light does not spread from the mask itself": rays.pupil_scale > 0})
        self.ray_map = RayMap(pupil_scale=1.0, field_scale=rays.ratio)
        self.per_shift = 1 / rays.pupil_scale
        propagation = Propagation(
            distance_m=rays.propagation_m(collimator_focal_length_m), wavenumber_rad_per_m=wavenumber_rad_per_m
        )
        step_rad = largest_step_rad(screen.samples_rad)
        finer = max(1, math.ceil(step_rad / LARGEST_STEP_RAD))
        spacing_m = screen.sample_spacing_m / rays.pupil_scale / finer
        margin = propagation.margin_m(step_rad / finer / spacing_m) / spacing_m + EDGE
        fine = [(count - 1) * finer + 1 for count in screen.samples_rad.shape]
        used = [half_m / rays.pupil_scale / spacing_m for half_m in half_width_m[::-1]]
        # The rim of the screen is part of the margin.
        pads = [max(0, math.ceil(half + margin - (count - 1) / 2)) for count, half in zip(fine, used, strict=True)]
        sides = [fft.next_fast_len(count + 2 * pad) for count, pad in zip(fine, pads, strict=True)]
        if max(sides) > _LARGEST_SIDE:
            raise ValueError(
                "rms_rad must be smaller, or correlation_length_m larger: the light of the screen would need "
                f"{max(sides):,} samples a side, and the most is {_LARGEST_SIDE:,}"
            )
        around = [(pad, side - count - pad) for pad, side, count in zip(pads, sides, fine, strict=True)]
        field = np.exp(1j * np.pad(_resampled(screen, finer), around, mode="reflect", reflect_type="odd"))
        if amplitude is not None:
            field *= np.pad(_resampled(amplitude, finer), around, mode="reflect")
        field *= propagation.taper(field.shape, sample_spacing_m=spacing_m)
        field = propagation(field, sample_spacing_m=spacing_m)
        rows, columns = (_middle(*sizes) for sizes in zip(pads, fine, used, strict=True))
        self._samples = field[rows, columns]
        super().__init__(self._samples, spacing_m)

    @cached_property
    def phase(self) -> PhaseScreen:
        """Phase of U_z without jumps, in pupil coordinates."""
        return PhaseScreen(unwrapped_phase(self._samples), self._spacing_m)


def _resampled(screen: PhaseScreen, finer: int) -> Floats:
    """Samples of the screen's spline, `finer` times as dense, (row, column)."""
    if finer == 1:
        return screen.samples_rad
    half_x_m, half_y_m = screen.half_width_m
    rows, columns = ((count - 1) * finer + 1 for count in screen.samples_rad.shape)
    x_m, y_m = np.linspace(-half_x_m, half_x_m, columns), np.linspace(-half_y_m, half_y_m, rows)
    return np.asarray(screen.basis(y_m, 0) @ screen.coefficients @ screen.basis(x_m, 1).T, np.float64)


def _middle(before: int, count: int, half_width: float) -> slice:
    """Middle of `count` samples after the first `before`, up to `half_width` and the spline's edge."""
    drop = math.floor((count - 1) / 2 - half_width + _ROUNDING) - EDGE
    return slice(before + drop, before + count - drop)


def unwrapped_phase(field: NDArray[np.complex128]) -> Floats:
    """Phase, rad, of a field, both (row, column).

    Its differences are right where they are below pi. Points of zero intensity, around which the phase winds, make it
    wrong by multiples of 2 pi. Wrapped differences are integrated by least squares, a Poisson equation with free edges
    (Ghiglia and Romero, J. Opt. Soc. Am. A 11, 107 (1994)), solved by the discrete cosine transform; the result is made
    congruent with the field's argument.
    """
    gradient_y, gradient_x = np.angle(field[1:] * field[:-1].conj()), np.angle(field[:, 1:] * field[:, :-1].conj())
    divergence = np.diff(gradient_y, axis=0, prepend=0, append=0) + np.diff(gradient_x, axis=1, prepend=0, append=0)
    rows, columns = (2 * np.cos(np.pi * np.arange(count) / count) - 2 for count in field.shape)
    eigenvalues = rows[:, None] + columns
    eigenvalues[0, 0] = 1.0  # of the piston, which is set below
    phase = fft.idctn(fft.dctn(divergence) / eigenvalues)
    phase += np.angle(np.mean(field * np.exp(-1j * phase)))
    return np.asarray(phase + np.angle(field * np.exp(-1j * phase)), np.float64)
