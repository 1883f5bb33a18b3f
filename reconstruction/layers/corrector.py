"""Best command of a corrector conjugate to some distance, and its residual over the field.

A corrector at the ratio r adds the phase C(u + r x) to the wavefront of the field position x (`layer_modes`). The best
command minimises the mean variance over the field positions, each without piston.
"""

import math
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from reconstruction.arrays import Floats
from reconstruction.geometry import Field, Sensor
from reconstruction.modes.polynomials import legendre, zernike

Influence = Literal["legendre", "zernike", "actuators"]

_POSITIONS = 7  # along each side of the field
_COUPLING = 0.15  # of an actuator's influence at its neighbour
_DEPENDENT = 1e-4  # eigenvalue over the largest, below which a command shows too little at the lenslets to be known


@dataclass(frozen=True, slots=True)
class Corrector:
    """Shapes that a corrector can take over its footprint: the rectangle that rays meet.

    Legendre polynomials over the footprint, Zernike polynomials over the circle around it, or Gaussian influences of
    a square grid of actuators.
    """

    influence: Influence
    count: int  # of modes, the piston included, or of actuators

    def __post_init__(self) -> None:
        if self.influence not in get_args(Influence):
            raise ValueError(f"the shapes of a corrector are {', '.join(get_args(Influence))}, not {self.influence}")
        least, most = (4, 1024) if self.influence == "actuators" else (2, 500)
        if not least <= self.count <= most:
            kind = "actuators" if self.influence == "actuators" else f"{self.influence} modes"
            raise ValueError(f"the number of {kind} must be {least} ... {most}")
        if self.influence == "actuators" and math.isqrt(self.count) ** 2 != self.count:
            raise ValueError("the number of actuators must be a square, such as 144")

    def shapes(self, x: Floats, y: Floats) -> Floats:
        """Phases per unit of command at normalised positions (...), without piston: (k, ...)."""
        if self.influence == "legendre":
            return legendre(self.count, x, y)[1:]
        if self.influence == "zernike":
            return zernike(self.count, x / math.sqrt(2), y / math.sqrt(2))[1:]
        side = math.isqrt(self.count)
        x, y = np.broadcast_arrays(x, y)
        at = np.linspace(-1, 1, side)
        narrow = -math.log(_COUPLING) * ((side - 1) / 2) ** 2
        along_y = np.exp(-narrow * (y[None] - at.reshape(-1, *[1] * y.ndim)) ** 2)
        along_x = np.exp(-narrow * (x[None] - at.reshape(-1, *[1] * x.ndim)) ** 2)
        return np.asarray((along_y[:, None] * along_x).reshape(side**2, *x.shape))


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Correction:
    """Best command of a corrector at one ratio, and what it leaves."""

    corrector: Corrector
    ratio: float
    half_width_m: Floats  # of the footprint, (xy,), in coordinates s = u + ratio x
    command: Floats  # rad, (k,); the corrector adds this phase
    residual_rad: Floats  # RMS at each field position, (position,); NaN where no lenslet is known
    strehl: Floats  # (position,)

    @property
    def mean_residual_rad(self) -> float:
        """Root of the mean square of the residuals over the field."""
        return float(np.sqrt(np.nanmean(self.residual_rad**2)))

    def phase(self, x_m: Floats, y_m: Floats) -> Floats:
        """Phase that the corrector adds at positions s (...), broadcast together, rad."""
        shapes = self.corrector.shapes(x_m / self.half_width_m[0], y_m / self.half_width_m[1])
        return np.tensordot(self.command, shapes, axes=1)

    def phase_map(self, pixels: int) -> tuple[Floats, Floats, Floats]:
        """Positions x (column,), y (row,), m, and phase (row, column) without piston; `pixels` on the longer side."""
        x_m, y_m = (
            np.linspace(-half_m, half_m, max(2, round(pixels * half_m / max(self.half_width_m))))
            for half_m in self.half_width_m
        )
        phase = self.phase(x_m, y_m[:, None])
        return x_m, y_m, np.asarray(phase - phase.mean())


def field_positions_m(field: Field) -> Floats:
    """Field positions, evenly spread over the field, at which correctors are checked, (position, xy)."""
    along = np.linspace(-1, 1, _POSITIONS)
    y, x = (grid.ravel() for grid in np.meshgrid(along, along, indexing="ij"))
    inside = field.contains(x, y)
    return np.stack([x, y], axis=-1)[inside] * field.half_width_m


def best_correction(
    wavefronts: Floats, *, positions_m: Floats, sensor: Sensor, field: Field, ratio: float, corrector: Corrector
) -> Correction:
    """Find the best command of a corrector for the wavefronts of some field positions (position, xy).

    They are (position, lenslet_row, lenslet_column), rad, NaN where unknown. `ratio` is that of field to pupil position
    where rays meet the corrector; 0 for one at the pupil. `ValueError` if no lenslet is known.
    """
    known = np.isfinite(wavefronts)
    lenslets = np.count_nonzero(known, axis=(1, 2))[:, None, None]
    if not lenslets.any():
        raise ValueError("no lenslet has a wavefront")
    half_width_m = np.array(sensor.pupil_half_width_m) + abs(ratio) * field.half_width_m
    x_m, y_m = positions_m.T[:, :, None, None]
    u_m, v_m = np.moveaxis(sensor.lenslet_centers_m, -1, 0)
    x, y = (u_m + ratio * x_m) / half_width_m[0], (v_m + ratio * y_m) / half_width_m[1]
    share = known / np.maximum(lenslets, 1)

    def without_piston(phase: Floats) -> Floats:
        return np.asarray((phase - np.sum(phase * share, axis=(-2, -1), keepdims=True)) * np.sqrt(share))

    matrix = without_piston(corrector.shapes(x, y)).reshape(-1, known.size)
    data = without_piston(np.where(known, wavefronts, 0.0)).ravel()
    square, vectors = np.linalg.eigh(matrix @ matrix.T)
    seen = square > _DEPENDENT * square[-1]
    fitted = vectors[:, seen] @ (vectors[:, seen].T @ (matrix @ data) / square[seen])
    left = (data - fitted @ matrix).reshape(known.shape)
    phase = np.where(known, left / np.sqrt(np.where(known, share, 1.0)), 0.0)
    is_known = lenslets.ravel() > 0
    return Correction(
        corrector=corrector,
        ratio=ratio,
        half_width_m=half_width_m,
        command=-fitted,
        residual_rad=np.where(is_known, np.sqrt(np.sum(left**2, axis=(1, 2))), np.nan),
        strehl=np.where(is_known, np.abs(np.sum(np.exp(1j * phase) * share, axis=(1, 2))) ** 2, np.nan),
    )
