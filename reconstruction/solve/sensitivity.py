"""Displacements caused by the modes of a wavefront: the design matrix of the modal reconstruction.

A lenslet's displacement is written in K parameters, the rows of `parameters` (K, x modes and then y modes).
"""

from typing import Protocol, TypeAlias

import numpy as np
from numpy.polynomial import legendre as series
from numpy.typing import NDArray

from reconstruction.arrays import Floats
from reconstruction.geometry import Sensor
from reconstruction.modes.lenslet_wavefronts import local_wavefronts
from reconstruction.modes.pupil_modes import PupilModes, aperture_rule

Lenslets: TypeAlias = slice | NDArray[np.intp]
_DEGREE = 4  # of the local wavefronts whose mean gradients stand for a response


class Sensitivity(Protocol):
    """Parameters of the lenslets' warps per rad, of local wavefronts and of pupil modes."""

    @property
    def response(self) -> Floats:
        """To local wavefronts P_m(xi) P_n(eta) T_q, px per rad, (lenslet or 1, n, m, field_mode, K)."""
        ...

    def __call__(self, modes: PupilModes, lenslets: Lenslets) -> Floats:
        """Parameters, px, of some lenslets per rad of each mode but the piston.

        (lenslet, K, pupil_mode - 1, field_mode).
        """
        ...


class MeanGradients:
    """Mean gradients of a wavefront over each lenslet, the same for all field modes."""

    def __init__(self, sensor: Sensor, parameters: Floats) -> None:
        """`parameters` (K, 2Q) found for a displacement (x modes, y modes)."""
        self._sensor = sensor
        self._along = parameters.reshape(len(parameters), 2, -1) / sensor.slope_per_px  # (K, xy, field_mode)

    @property
    def response(self) -> Floats:
        """To local wavefronts, px per rad, (1, n, m, field_mode, K)."""
        sensor = self._sensor
        half_m = sensor.aperture_width_m / 2
        position, weights = aperture_rule(sensor.arrangement)
        xi, eta = position.T * sensor.lenslet_pitch_m / half_m
        derive = series.legder(np.eye(_DEGREE + 1))
        (p, slope_p), (r, slope_r) = (
            (series.legvander(at, _DEGREE), series.legvander(at, _DEGREE - 1) @ derive) for at in (xi, eta)
        )
        along_x, along_y = (np.einsum("a,an,am->nm", weights, *pair) / half_m for pair in ((r, slope_p), (slope_r, p)))
        within = np.add.outer(np.arange(_DEGREE + 1), np.arange(_DEGREE + 1)) <= _DEGREE
        gradient = np.stack([along_x, along_y]) * within  # 1/m, (xy, n, m)
        return np.asarray(np.einsum("anm,kaq->nmqk", gradient, self._along))[None]

    def __call__(self, modes: PupilModes, lenslets: Lenslets) -> Floats:
        """Parameters per rad of each mode; see `Sensitivity`."""
        gradients = modes.gradients[1:].reshape(len(modes.gradients) - 1, -1, 2)[:, lenslets]
        return np.asarray(np.einsum("plx,kxq->lkpq", gradients, self._along, optimize=True))


class Response:
    """Response of the registration to local wavefronts, see `registration.response`."""

    def __init__(self, sensor: Sensor, response: Floats) -> None:
        """`response` is (lenslet, n, m, field_mode, K), px per rad."""
        self._sensor, self.response = sensor, response
        self._n, self._m = np.nonzero(np.any(response, axis=(0, 3, 4)))

    def __call__(self, modes: PupilModes, lenslets: Lenslets) -> Floats:
        """Parameters per rad of each mode; see `Sensitivity`."""
        local = local_wavefronts(modes.products[1:], self._sensor, self.response.shape[1] - 1)
        local = local.reshape(-1, *local.shape[2:])[lenslets][:, self._n, self._m]  # (lenslet, j, pupil_mode - 1)
        of_local = self.response[lenslets][:, self._n, self._m]
        return np.asarray(np.einsum("ljp,ljqk->lkpq", local, of_local, optimize=True))
