"""The result: the wavefront at every position of the field, with its error bars."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol, Self

import numpy as np

from reconstruction.arrays import Floats, Mask
from reconstruction.displacement import Displacement
from reconstruction.geometry import Field, Sensor
from reconstruction.modes.field_modes import FieldModes
from reconstruction.solve.modal import ModalSolution


class Solution(Protocol):
    """What zonal and modal reconstruction leave behind: the wavefront of any combination of field modes."""

    def wavefront(self, field_modes: Floats) -> Floats:
        """Wavefront, rad, without piston, where the field modes T_q have the values `field_modes` (..., field_mode).

        Shape (..., lenslet_row, lenslet_column); NaN where nothing is known.
        """
        ...

    def sigma(self, field_modes: Floats) -> Floats:
        """Standard deviation of `wavefront`, rad, the same shape."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Wavefront:
    """What one frame says about the wavefront at every position of the field."""

    sensor: Sensor
    field: Field
    displacement: Displacement
    solution: Solution
    views: Floats  # of each view, rad, (view_row, view_column, lenslet_row, lenslet_column); NaN outside the field

    @classmethod
    def of(cls, sensor: Sensor, field: Field, displacement: Displacement, solution: Solution) -> Self:
        """Evaluate a solution at the views of the field."""
        return cls(sensor, field, displacement, solution, _at_views(field, displacement, solution.wavefront))

    @property
    def coefficients(self) -> Floats | None:
        """Dual-orthogonal coefficients e_pq, rad, (pupil_mode, field_mode); None for a zonal reconstruction."""
        return self.solution.coefficients if isinstance(self.solution, ModalSolution) else None

    def sigma(self) -> Floats:
        """Standard deviation of each view's wavefront, rad, the shape of `views`; takes some milliseconds."""
        return _at_views(self.field, self.displacement, self.solution.sigma)

    def at(self, x_m: float, y_m: float) -> Floats:
        """Wavefront at the field position (x, y) in m, at the lenslet centres: (lenslet_row, lenslet_column), rad."""
        x, y = x_m / self.field.half_width_m, y_m / self.field.half_width_m
        if not self.field.contains(x, y):
            raise ValueError(f"({x_m:g}, {y_m:g}) m lies outside the field of +-{self.field.half_width_m:g} m")
        return self.solution.wavefront(self.displacement.modes.values(x, y))


def without_piston(phase: Floats) -> Floats:
    """The wavefronts (..., lenslet_row, lenslet_column) minus the mean of each, NaN left out."""
    return phase - _mean(phase)[..., None, None]


def rms(phase: Floats) -> Floats:
    """Root mean square about the mean of each wavefront (..., lenslet_row, lenslet_column), NaN left out: (...)."""
    return np.sqrt(_mean(without_piston(phase) ** 2))


def peak_to_valley(phase: Floats) -> Floats:
    """Highest minus lowest value of each wavefront (..., lenslet_row, lenslet_column), NaN left out: (...)."""
    highest = np.max(phase, axis=(-2, -1), initial=-np.inf, where=~np.isnan(phase))
    lowest = np.min(phase, axis=(-2, -1), initial=np.inf, where=~np.isnan(phase))
    return np.where(highest >= lowest, highest - lowest, np.nan)


def _mean(values: Floats) -> Floats:
    """Mean over the lenslets, NaN left out; NaN when nothing is left."""
    known = ~np.isnan(values)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.sum(values, axis=(-2, -1), where=known) / np.count_nonzero(known, axis=(-2, -1)))


def _at_views(field: Field, displacement: Displacement, evaluate: Callable[[Floats], Floats]) -> Floats:
    """Evaluate a function of the field modes at the views, NaN outside the field."""
    field_modes, is_inside = _modes_at_views(field, displacement.modes)
    values = evaluate(field_modes)
    values[~is_inside] = np.nan
    return values


@lru_cache(maxsize=16)
def _modes_at_views(field: Field, modes: FieldModes) -> tuple[Floats, Mask]:
    """The field modes at the views (view_row, view_column, field_mode), and which views lie in the field."""
    x, y = field.view_x_m / field.half_width_m, field.view_y_m / field.half_width_m
    return np.moveaxis(modes.values(x, y[:, None]), 0, -1).copy(), field.contains(x, y[:, None])
