"""The wavefront at every field position, with its error bars; RMS and low orders of wavefronts."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import lru_cache
from typing import Self, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from reconstruction.arrays import Booleans, Floats
from reconstruction.displacement import TRANSMISSION_MODES, Displacement
from reconstruction.geometry import Field, Sensor
from reconstruction.layers.layered_wavefront import FREE, AssumedSample
from reconstruction.modes.field_modes import FieldModes
from reconstruction.modes.polynomials import zernike
from reconstruction.pictures import html, picture_of_views
from reconstruction.runtime.deferred import Deferred
from reconstruction.solve.modal import ModalSolution
from reconstruction.solve.zonal import ZonalSolution

Solution: TypeAlias = ZonalSolution | ModalSolution
"""Result of the reconstruction: the wavefront of any combination of field modes, and its standard deviation."""


@dataclass(frozen=True, slots=True, eq=False)
class Wavefront:
    """Wavefront of one frame at every field position."""

    sensor: Sensor
    field: Field
    displacement: Displacement
    solution: Solution
    views: Floats  # rad, (view_row, view_column, lenslet_row, lenslet_column); NaN where unknown or outside the field
    sample: AssumedSample  # that was assumed
    sigma_source: Deferred[Floats] | None = None  # `sigma`, if the solution does not compute it

    @classmethod
    def of(
        cls, sensor: Sensor, field: Field, displacement: Displacement, solution: Solution, sample: AssumedSample = FREE
    ) -> Self:
        """Evaluate a solution at the views of the field."""
        views = _at_views(field, displacement, solution.wavefront)
        views.setflags(write=False)
        return cls(sensor, field, displacement, solution, views, sample)

    @property
    def coefficients(self) -> Floats | None:
        """Dual-orthogonal coefficients e_pq, rad, (pupil_mode, field_mode); None for a zonal reconstruction."""
        return self.solution.coefficients if isinstance(self.solution, ModalSolution) else None

    def sigma(self) -> Floats:
        """Standard deviation of `views`, rad, the same shape."""
        if self.sigma_source is not None:
            return self.sigma_source()
        return _at_views(self.field, self.displacement, self.solution.sigma)

    @property
    def transmission(self) -> tuple[Floats, Floats] | None:
        """Transmission of the sample at the views, and its standard error, of the shape of `views`.

        The brightness of each source point over that in the reference, quadratic over the field: without a sample 1. A
        lamp that became brighter changes all values alike. NaN where a lenslet is lost or partly covered. None if the
        method of registration does not measure it.
        """
        if (found := self.displacement.transmission) is None:
            return None
        modes, is_inside = modes_at_views(self.field, TRANSMISSION_MODES)
        value, sigma = (np.where(is_inside[..., None, None], each, np.nan) for each in found.at(modes))
        return value, sigma

    def at(self, x_m: ArrayLike, y_m: ArrayLike) -> Floats:
        """Wavefront at field positions, rad, (..., lenslet_row, lenslet_column); NaN where unknown.

        It has no piston.

        Parameters
        ----------
        x_m, y_m : (...)
            Field positions, broadcast against each other; numbers for a single one.

        Raises
        ------
        ValueError
            If one lies outside the field.
        """
        x_m, y_m = np.broadcast_arrays(np.asarray(x_m, np.float64), np.asarray(y_m, np.float64))
        half_width_m = self.field.half_width_m
        x, y = x_m / half_width_m, y_m / half_width_m
        outside = ~self.field.contains(x, y)
        if outside.any():
            place = f"({x_m[outside][0]:g}, {y_m[outside][0]:g}) m"
            raise ValueError(f"{place} lies outside the field of +-{half_width_m:g} m")
        return self.solution.wavefront(np.moveaxis(self.displacement.modes.values(x, y), 0, -1))

    def __repr__(self) -> str:
        valid, (rows, columns, *lenslets) = self.displacement.valid, self.views.shape
        mean_rad = mean_rms(self.views)
        size = f"{rows} x {columns} views of {lenslets[0]} x {lenslets[1]} lenslets"
        mean = "unknown" if np.isnan(mean_rad) else f"mean RMS {mean_rad:.3f} rad"
        layers = f"{len(self.sample.ratios)} assumed" if self.sample.ratios else "any wavefront"
        return f"<Wavefront: {size}, {np.count_nonzero(valid)} valid; {mean}; layers: {layers}>"

    def _repr_html_(self) -> str:
        return html(repr(self), picture_of_views(self.views))


def without_piston(phase: Floats) -> Floats:
    """Subtract the mean of each wavefront (..., lenslet_row, lenslet_column), ignoring NaN."""
    return phase - mean_known(phase)[..., None, None]


def rms(phase: Floats) -> Floats:
    """RMS about the mean of each wavefront (..., lenslet_row, lenslet_column), ignoring NaN: (...)."""
    return np.sqrt(mean_known(without_piston(phase) ** 2))


def mean_rms(views: Floats) -> float:
    """Mean RMS, rad, of known views (view_row, view_column, lenslet_row, lenslet_column); else NaN."""
    return float(mean_known(rms(views), axis=None))


def peak_to_valley(phase: Floats) -> Floats:
    """Peak to valley of each wavefront (..., lenslet_row, lenslet_column), ignoring NaN: (...)."""
    highest = np.max(phase, axis=(-2, -1), initial=-np.inf, where=~np.isnan(phase))
    lowest = np.min(phase, axis=(-2, -1), initial=np.inf, where=~np.isnan(phase))
    return np.where(highest >= lowest, highest - lowest, np.nan)


def mean_known(values: Floats, axis: tuple[int, ...] | None = (-2, -1)) -> Floats:
    """Mean over axes, by default over the lenslets, ignoring NaN; NaN where all are."""
    known = ~np.isnan(values)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.sum(values, axis=axis, where=known) / np.count_nonzero(known, axis=axis))


def _at_views(field: Field, displacement: Displacement, evaluate: Callable[[Floats], Floats]) -> Floats:
    """Evaluate a function of the field modes at the views; NaN outside the field."""
    field_modes, is_inside = modes_at_views(field, displacement.modes)
    values = evaluate(field_modes)
    values[~is_inside] = np.nan
    return values


@lru_cache(maxsize=16)
def modes_at_views(field: Field, modes: FieldModes) -> tuple[Floats, Booleans]:
    """Field modes at the views (view_row, view_column, field_mode), and the views inside the field."""
    x, y = field.view_x_m / field.half_width_m, field.view_y_m / field.half_width_m
    return np.moveaxis(modes.values(x, y[:, None]), 0, -1).copy(), field.contains(x, y[:, None])


def without_zernikes(phase: Floats, numbers: Iterable[int], sensor: Sensor) -> Floats:
    """Subtract piston and Zernike modes by Noll's numbers, ignoring NaN.

    From wavefronts (..., lenslet_row, lenslet_column), rad. All modes up to the last one are fitted together to all
    known lenslets. They are those of the pupil's circle or annulus.
    """
    if not (removed := [number - 1 for number in numbers]):
        return without_piston(phase)
    x, y = np.moveaxis(sensor.circle.normalised(sensor.lenslet_centers_m), -1, 0)
    terms = zernike(max(removed) + 1, x, y, sensor.circle.obscuration)  # (term, lenslet_row, lenslet_column)
    terms = terms / np.sqrt(np.mean(terms**2, axis=(1, 2), keepdims=True))
    known = np.isfinite(phase)
    normal = np.tensordot(known.astype(np.float64), terms[:, None] * terms, axes=((-2, -1), (-2, -1)))
    moments = np.tensordot(np.where(known, phase, 0), terms, axes=((-2, -1), (-2, -1)))
    fitted = (np.linalg.pinv(normal, hermitian=True) @ moments[..., None])[..., removed, 0]
    return without_piston(phase - np.tensordot(fitted, terms[removed], axes=1))
