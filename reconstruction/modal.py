"""Modal reconstruction: the dual-orthogonal coefficients e_pq of the space-variant wavefront.

With the displacement of every lenslet written as d = sum_q c_q T_q, each field mode q is an independent least-squares
problem with one and the same matrix: G e_q = (k/f) c_q, G the mean gradient of the pupil mode R_p over each lenslet.
For three field modes this is the paper's e = pinv(M) d; it holds for any number.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from reconstruction.displacement import Mask
from reconstruction.errors import ReconstructionError
from reconstruction.geometry import Floats
from reconstruction.pupil_modes import PupilModes


@dataclass(frozen=True, slots=True, eq=False)
class ModalSolution:
    """The dual-orthogonal coefficients of one wavefront."""

    coefficients: Floats  # e_pq, rad, (pupil_mode, field_mode); zero for the piston, which slopes do not show
    sigma: Floats  # their standard deviations, rad, the same shape
    pupil_modes: Floats  # R_p at the lenslet centres, (pupil_mode, lenslet_row, lenslet_column)
    known: Mask  # the lenslets that it was fitted to; elsewhere polynomials would only invent

    def wavefront(self, field_modes: Floats) -> Floats:
        """Wavefront, rad, where the field modes have the values (..., field_mode); see `wavefront.Solution`."""
        phase = np.tensordot(field_modes @ self.coefficients.T, self.pupil_modes[:, self.known], axes=1)
        wavefront = np.full((*phase.shape[:-1], *self.known.shape), np.nan)
        wavefront[..., self.known] = phase - phase.mean(axis=-1, keepdims=True)
        return wavefront


class ModalSolver:
    """Fits pupil modes to the slopes of the lenslets inside the pupil.

    The pseudo-inverse of each set of valid lenslets is kept.
    """

    def __init__(self, modes: PupilModes) -> None:
        """Prepare for the modes of a pupil, the piston first."""
        self._inside = modes.inside
        gradients = modes.gradients[1:]
        self._gradients = gradients.reshape(len(gradients), -1)  # (pupil_mode without piston, lenslet x xy), 1/m
        self._values = modes.values
        self._pseudo_inverse(modes.inside.tobytes())  # says at once if even all lenslets cannot tell the modes apart

    def __call__(self, slopes: Floats, variance: Floats, valid: Mask) -> ModalSolution:
        """Fit the slopes (lenslet_row, lenslet_column, field_mode, xy), rad/m, of the valid lenslets.

        `variance`, of the same shape, is that of the slopes, (rad/m)^2: it becomes the coefficients' sigma.
        """
        valid = valid & self._inside
        inverse = self._pseudo_inverse(valid.tobytes())
        data = np.swapaxes(slopes[valid], 1, 2).reshape(-1, slopes.shape[2])
        spread = np.swapaxes(variance[valid], 1, 2).reshape(-1, slopes.shape[2])
        piston = np.zeros((1, slopes.shape[2]))
        return ModalSolution(
            coefficients=np.concatenate([piston, inverse @ data]),
            sigma=np.concatenate([piston, np.sqrt(inverse**2 @ spread)]),
            pupil_modes=self._values,
            known=valid,
        )

    @lru_cache(maxsize=16)  # noqa: B019 - a solver lives as long as its reference, and so may what it remembers
    def _pseudo_inverse(self, valid_bytes: bytes) -> Floats:
        """Least-squares inverse of the mean gradients of the valid lenslets: (pupil_mode - 1, lenslet x xy), m."""
        valid = np.frombuffer(valid_bytes, np.bool_)
        matrix = self._gradients[:, np.repeat(valid, 2)].T
        u, singular, vt = np.linalg.svd(matrix, full_matrices=False)
        modes = self._gradients.shape[0]
        if singular.size < modes or singular[-1] < 1e-6 * singular[0]:
            raise ReconstructionError(
                f"{np.count_nonzero(valid)} valid lenslets cannot tell {modes + 1} pupil modes apart: lower pupil_modes"
            )
        return np.asarray((vt.T / singular) @ u.T)
