"""The pupil over which wavefronts are shown: a circle, perhaps with a central obscuration."""

import math
from dataclasses import dataclass
from typing import Self

import numpy as np

from app.errors import InputError
from reconstruction.arrays import Booleans, Floats
from reconstruction.geometry import Sensor


@dataclass(frozen=True, slots=True)
class Pupil:
    """A circle at the lenslets, or an annulus; positions are measured from the middle of the lattice."""

    x_m: float  # of the centre
    y_m: float
    radius_m: float
    obscuration: float = 0.0  # radius of the central shadow over that of the pupil

    @classmethod
    def fitted(cls, sensor: Sensor, valid: Booleans) -> Self:
        """Fit a pupil to the area and the second moment of the valid lenslets (lenslet_row, lenslet_column).

        There is a shadow if the lenslet in the middle is lost. `InputError` if no lenslet is valid.
        """
        if not valid.any():
            raise InputError("a pupil cannot be fitted: no lenslet is valid")
        at_m, cell_m2 = sensor.lenslet_centers_m[valid], sensor.lenslet_pitch_m * sensor.row_spacing_m
        x_m, y_m = at_m.mean(axis=0).tolist()
        area_m2 = len(at_m) * cell_m2
        distance_m = _distances_m(sensor, x_m, y_m)
        if valid.flat[distance_m.argmin()]:
            return cls(x_m, y_m, math.sqrt(area_m2 / math.pi))
        mean_square_m2 = float(np.mean(distance_m[valid] ** 2)) + cell_m2 / 6  # of the cells, not only their centres
        outer_m2 = mean_square_m2 + area_m2 / (2 * math.pi)
        inner_m2 = max(mean_square_m2 - area_m2 / (2 * math.pi), 0.0)
        return cls(x_m, y_m, math.sqrt(outer_m2), math.sqrt(inner_m2 / outer_m2))

    def contains(self, sensor: Sensor) -> Booleans:
        """Return the lenslets (lenslet_row, lenslet_column) whose centres lie in the pupil."""
        share = _distances_m(sensor, self.x_m, self.y_m) / self.radius_m
        return np.asarray((self.obscuration <= share) & (share <= 1))

    @property
    def edges_m(self) -> Floats:
        """Edges of pupil and shadow as pairs of ends (2 * segment, xy)."""
        turn = np.exp(2j * np.pi * np.arange(73) / 72)
        around = np.repeat(np.stack([turn.real, turn.imag], axis=-1), 2, axis=0)[1:-1]
        radii_m = np.array([self.radius_m, self.radius_m * self.obscuration])
        return np.asarray(np.array([self.x_m, self.y_m]) + np.concatenate(radii_m[:, None, None] * around))

    @property
    def in_words(self) -> str:
        """Diameter and shadow, for a caption."""
        shadow = f", obscuration {100 * self.obscuration:.0f} %" if self.obscuration else ""
        return f"pupil {2e3 * self.radius_m:.2f} mm{shadow}"


def _distances_m(sensor: Sensor, x_m: float, y_m: float) -> Floats:
    away_m = sensor.lenslet_centers_m - (x_m, y_m)
    return np.hypot(away_m[..., 0], away_m[..., 1])
