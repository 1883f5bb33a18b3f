"""The pupil: the part of the lenslets over which wavefronts count, `[pupil]` of a bench."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Literal, Self, TypeAlias

import numpy as np
from annotated_types import Ge, Gt, Le
from typing_extensions import Doc

from reconstruction.annotated_settings import Checked
from reconstruction.arrays import Booleans, Floats

Shape: TypeAlias = Literal["automatic", "fit", "circle", "annulus", "square", "all"]

_LEAST_ROUND = 12  # lit lenslets; fewer show no shape
_ROUNDING = 1e-9
_WRONG = 0.03  # share of lenslets that a round pupil may get wrong, apart from those at its edges


@dataclass(frozen=True, slots=True, kw_only=True)
class Pupil(Checked):
    """Part of the lenslets over which wavefronts count; positions are measured from the middle of the lattice."""

    shape: Annotated[
        Shape,
        Doc(
            "Shape of the pupil. fit: circle or annulus around the lenslets with light; all: no pupil; automatic: fit"
            " if these lenslets are round, all otherwise"
        ),
    ] = "automatic"
    center_x_m: Annotated[float, Ge(-1), Le(1), Doc("Centre, along the lattice's rows")] = 0.0
    center_y_m: Annotated[float, Ge(-1), Le(1), Doc("Centre, along the lattice's columns")] = 0.0
    radius_m: Annotated[float, Gt(0), Le(1), Doc("Radius of circle or annulus, half of a square's side")] | None = None
    obscuration: Annotated[float, Ge(0), Le(0.95), Doc("Shadow of an annulus, its radius over radius_m")] = 0.0

    @property
    def is_bounded(self) -> bool:
        """True if it has an edge: it is given, or was fitted."""
        return self.shape in {"circle", "annulus", "square"}

    def faults(self) -> Iterator[tuple[str, str]]:
        """Yield settings that contradict others, and why."""
        if self.shape == "automatic" and self.radius_m is not None:
            yield "shape", 'must be "circle", "annulus" or "square" with a radius'
        if self.is_bounded and self.radius_m is None:
            yield "radius_m", f'is missing, which shape = "{self.shape}" needs'
        if self.is_bounded and (self.obscuration > 0) != (self.shape == "annulus"):
            yield "obscuration", f'must be {"above 0" if self.shape == "annulus" else "0"} with shape = "{self.shape}"'

    @classmethod
    def round(cls, center_m: tuple[float, float], radius_m: float, obscuration: float = 0.0) -> Self:
        """Make a circle, or an annulus with an obscuration, about a centre (xy,)."""
        shape: Shape = "annulus" if obscuration else "circle"
        x_m, y_m = center_m
        return cls(shape=shape, center_x_m=x_m, center_y_m=y_m, radius_m=radius_m, obscuration=obscuration)

    @classmethod
    def fitted(cls, at_m: Floats, lit: Booleans, cell_m2: float) -> Self:
        """Fit a circle or annulus to area and second moment of the lit lenslets (lenslet_row, lenslet_column).

        From the lenslet centres `at_m` (lenslet_row, lenslet_column, xy) and the area of a cell. There is a shadow if
        the lenslet in the middle is unlit. `ValueError` if no lenslet is lit.
        """
        if not lit.any():
            raise ValueError("a pupil cannot be fitted: no lenslet is valid")
        x_m, y_m = at_m[lit].mean(axis=0).tolist()
        area_m2, half_m = np.count_nonzero(lit) * cell_m2, math.sqrt(cell_m2) / 2
        distance_m = np.hypot(*np.moveaxis(at_m - (x_m, y_m), -1, 0))
        outer_m, inner_m = math.sqrt(area_m2 / math.pi), 0.0
        if not lit.flat[distance_m.argmin()]:
            mean_square_m2 = float(np.mean(distance_m[lit] ** 2)) + cell_m2 / 6  # of the cells, not only their centres
            outer_m = math.sqrt(mean_square_m2 + area_m2 / (2 * math.pi))
            inner_m = math.sqrt(max(mean_square_m2 - area_m2 / (2 * math.pi), 0.0))
            inner_m = min(inner_m, (1 - _ROUNDING) * distance_m[lit & (distance_m > inner_m - half_m)].min())
        # Centres of lit lenslets at the edges lie inside.
        outer_m = max(outer_m, (1 + _ROUNDING) * distance_m[lit & (distance_m < outer_m + half_m)].max(initial=0.0))
        return cls.round((x_m, y_m), float(outer_m), float(inner_m / outer_m))

    def found(self, at_m: Floats, lit: Booleans, cell_m2: float) -> "Pupil":
        """Return the pupil, fitted to the lit lenslets if its shape is "fit", or "automatic" and they are round."""
        if self.shape not in {"automatic", "fit"}:
            return self
        if lit.any() and (self.shape == "fit" or _is_round(at_m, lit, cell_m2)):
            return Pupil.fitted(at_m, lit, cell_m2)
        return Pupil(shape="all")

    def contains(self, at_m: Floats) -> Booleans:
        """True for positions (..., xy) in the pupil; for all before the pupil is fitted."""
        if not self.is_bounded:
            return np.ones(at_m.shape[:-1], np.bool_)
        x, y = np.moveaxis(self.normalised(at_m), -1, 0)
        if self.shape == "square":
            return np.asarray(np.maximum(np.abs(x), np.abs(y)) <= 1)
        share = np.hypot(x, y)
        return np.asarray((self.obscuration <= share) & (share <= 1))

    def normalised(self, at_m: Floats) -> Floats:
        """Positions (..., xy) from the pupil's centre over its radius."""
        return np.asarray((at_m - (self.center_x_m, self.center_y_m)) / (self.radius_m or math.nan))

    @property
    def edges_m(self) -> Floats:
        """Edges of pupil and shadow as pairs of ends (2 * segment, xy)."""
        if self.radius_m is None or not self.is_bounded:
            return np.zeros((0, 2))
        turn = np.exp(2j * np.pi * np.arange(73) / 72)
        if self.shape == "square":
            turn = np.array([1 + 1j, -1 + 1j, -1 - 1j, 1 - 1j, 1 + 1j])
        around = np.repeat(np.stack([turn.real, turn.imag], axis=-1), 2, axis=0)[1:-1]
        radii_m = self.radius_m * np.array([1.0, self.obscuration])
        edges_m = np.concatenate(radii_m[:, None, None] * around)
        return np.asarray(edges_m + np.array([self.center_x_m, self.center_y_m]))

    @property
    def in_words(self) -> str:
        """Size and shadow, for a caption."""
        if self.radius_m is None or not self.is_bounded:
            return ""
        shadow = f", obscuration {100 * self.obscuration:.0f} %" if self.obscuration else ""
        return f"{'square ' * (self.shape == 'square')}pupil {2e3 * self.radius_m:.2f} mm{shadow}"


def _is_round(at_m: Floats, lit: Booleans, cell_m2: float) -> bool:
    """True if a circle or annulus on the lattice describes the lit lenslets better than their rows and columns."""
    if np.count_nonzero(lit) < _LEAST_ROUND:
        return False
    pupil, half_m = Pupil.fitted(at_m, lit, cell_m2), math.sqrt(cell_m2) / 2
    radius_m, ends_m = pupil.radius_m or 0.0, at_m.reshape(-1, 2)
    center_m = np.array([pupil.center_x_m, pupil.center_y_m])
    if (ends_m.min(axis=0) - 2 * half_m > center_m - radius_m).any() or (
        ends_m.max(axis=0) + 2 * half_m < center_m + radius_m
    ).any():
        return False  # the lattice cuts it
    distance_m = radius_m * np.hypot(*np.moveaxis(pupil.normalised(at_m), -1, 0))
    is_beyond = distance_m > radius_m + half_m
    is_within = (distance_m < radius_m - half_m) & (distance_m > radius_m * pupil.obscuration + half_m)
    wrong = np.count_nonzero(np.where(lit, is_beyond, is_within))
    rows, columns = lit.any(axis=1), lit.any(axis=0)
    in_rows_and_columns = np.outer(rows, columns) & ~(distance_m < radius_m * pupil.obscuration)
    unlike, unlike_rectangle = (np.count_nonzero(lit != one) for one in (pupil.contains(at_m), in_rows_and_columns))
    return bool(wrong <= _WRONG * np.count_nonzero(lit) and unlike < unlike_rectangle)
