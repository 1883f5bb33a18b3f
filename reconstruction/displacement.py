"""What every method of registration finds: how each lenslet's subimage lies with respect to the reference."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import Floats, Image, Mask
from reconstruction.modes.field_modes import FieldModes

Outcomes = NDArray[np.int8]  # an `Outcome` for every lenslet


class Outcome(IntEnum):
    """What became of a lenslet; all but CONVERGED mean that it yields no slope."""

    CONVERGED = 0
    DARK = 1  # no light in the reference or in the frame
    SATURATED = 2
    DIVERGED = 3
    LEFT_CELL = 4  # the subimage reaches into the neighbour's cell: beyond the dynamic range
    OFF_CAMERA = 5  # the lenslet's cell is not wholly on the camera


@dataclass(frozen=True, slots=True, eq=False)
class Displacement:
    """How the subimages of a frame lie with respect to the reference."""

    modes: FieldModes  # the T_q in which the displacements are written
    coefficients: Floats  # c_q, px, (lenslet_row, lenslet_column, field_mode, xy); NaN where not converged
    covariance: Floats  # px^2, (lenslet_row, lenslet_column, field_mode, xy, field_mode, xy); NaN likewise
    outcome: Outcomes  # (lenslet_row, lenslet_column)
    residual_rms: Floats  # misfit over the contrast of the reference's best subimage; NaN likewise
    chi_square: Floats  # misfit over what the camera's noise makes, squares; NaN likewise, and where it is not known
    range_used: Floats  # how far the field's edge is displaced over how far it may be; above 1 only where LEFT_CELL

    @property
    def valid(self) -> Mask:
        """Which lenslets have converged, (lenslet_row, lenslet_column)."""
        return np.asarray(self.outcome == Outcome.CONVERGED)

    @property
    def variance(self) -> Floats:
        """Variance of each coefficient, px^2, (lenslet_row, lenslet_column, field_mode, xy)."""
        return np.asarray(np.einsum("rcqdqd->rcqd", self.covariance))

    @property
    def mean(self) -> Floats:
        """Mean displacement over the field, px, (lenslet_row, lenslet_column, xy)."""
        nodes, weights = np.polynomial.legendre.leggauss(6)
        values = self.modes.values(nodes, nodes[:, None])
        return np.tensordot(np.einsum("qyx,y,x->q", values, weights, weights) / 4, self.coefficients, axes=([0], [2]))


def diagonal_covariance(variance: Floats) -> Floats:
    """Covariance (..., field_mode, xy, field_mode, xy) of coefficients whose errors are independent.

    `variance` (..., field_mode, xy) of each, px^2.
    """
    modes, axes = variance.shape[-2:]
    return np.asarray(variance[..., None, None] * np.eye(modes * axes).reshape(modes, axes, modes, axes))


class RegistrationMethod(Protocol):
    """A method of registration, prepared for one reference."""

    def __call__(self, light: Image, *, saturated: Mask, start: Displacement | None = None) -> Displacement:
        """Compare a frame (row, column), counts above the dark, with the reference.

        `saturated` (row, column) marks the pixels at full scale. `start`, the displacement of a frame not long before,
        may save time; it does not change the result.
        """
        ...
